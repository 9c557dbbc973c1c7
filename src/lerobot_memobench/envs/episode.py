"""One episode of one seed: settle, show the prompt, idle where the task does, let the policy act, keep the books.

The gym environment and the recorder of demonstrations both run on this class, so datasets and a policy's
observations at evaluation cannot drift apart.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_memobench.envs.pacing import NOTHING, Pacing
from lerobot_memobench.envs.prompt_cache import Prompt, prompt_file, prompt_of
from lerobot_memobench.envs.settings import DEFAULTS, EnvSettings, steps_per_action
from lerobot_memobench.experts.blind import blind_routine
from lerobot_memobench.experts.demonstration_prompt import PromptDemonstrator
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.protocol import (
    ACTION_DIM,
    CAMERAS,
    ENDED,
    EXECUTION,
    HORIZON,
    IDLE_STEPS,
    IMAGE_SIZE,
    NO_CLOCK,
    PROMPT,
    PROMPT_HORIZON,
    SPLITS,
    UPSTREAM,
    UPSTREAM_EVALUATIONS,
    UPSTREAM_HORIZON,
)
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.raster.drawlist import Image
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import InvalidActionError, Simulation, UnstablePhysicsError, as_action
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.evidence import Choice
from lerobot_memobench.tasks.failures import INVALID_ACTION, UNSTABLE_PHYSICS
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.memory_text import subtask_texts
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import STRICT, Task, referent_text


class Fault(NamedTuple):
    """What broke an execution off: one of `tasks.failures.FAULTS`, and why in a sentence."""

    failure: str
    why: str


class Episode:
    """An episode of one task; `reset` starts it for a seed.

    Args:
        task: the published task.
        settings: of the environment; those of an episode are ``referent``, ``demonstration_prompt``, ``horizon``,
            ``protocol``, ``render`` and the pacing. Objects hidden by a prompt that is not shown are hidden unseen.
        render: size and quality of frames; as in ``settings`` when None.
        changes: settings by name, other than in ``settings``.

    Attributes:
        task: the task of this episode: a variant of the given one when the referent is random.
        step_index: control steps since the episode began, prompt included.
        exec_start: the frame at which execution began; None during the prompt.
        progress: checkpoints and goal, counted in execution steps.
        applied_action: the action (7,) float32 that really moved the arm in the last step.
        rested: the last step was one of a pause: the scene stood still, and nothing but the clock went on.
        fault: what broke the execution off; None as long as nothing has.
        choice: which variant the execution chooses; None where it is not followed.
    """

    def __init__(
        self, task: Task, settings: EnvSettings = DEFAULTS, *, render: RenderSettings | None = None, **changes: Any
    ) -> None:
        self.settings = settings = settings.changed(**changes)
        render = render or RenderSettings(IMAGE_SIZE, IMAGE_SIZE, settings.render)
        self.published = task
        self.referent = referent_text(settings.referent, task.drawn)
        self._limit = settings.horizon * steps_per_action(settings.speed)
        self.demonstration_prompt = settings.demonstration_prompt and task.prompt is not None
        self.sim = Simulation(task, render)
        self._slots: ObjectSlots | None = None
        self.task = task
        self.seed = -1

    def _rng(self, stream: int) -> np.random.Generator:
        return generator(self.published, self.seed, stream)

    def reset(self, seed: int, variant: int | None = None, *, keep_prompt: bool = False) -> None:
        """Start the episode of a seed. Everything that follows is a function of task, settings, seed and actions.

        Args:
            seed: of the scene.
            variant: the one that is shown, whatever the seed draws; which one the execution chooses is then followed.
            keep_prompt: whether its prompt is simulated once and kept (`prompt_cache`).
        """
        self.seed = int(seed)
        self.fault: Fault | None = None
        if variant is None:
            task = self.published if self.referent == "fixed" else referent_of(self.published, self.seed)
        else:
            task = self.published.variant(variant)
        self.task = task
        self.choice = None if variant is None else Choice(task)
        if self.settings.protocol == UPSTREAM:
            self.progress = Progress(task, UPSTREAM_EVALUATIONS)
            self.sim.reset(self.seed, self.progress.settle)
        else:
            self.progress = Progress(task)
            self.sim.reset(self.seed)
        self.scene_hash = self.sim.scene_hash()
        self._start = self.sim.snapshot()
        self.step_index = 0
        self.exec_start: int | None = None
        self.pacing = Pacing(self.settings, self._rng(4))
        self.rested = False
        self.applied_action: NDArray[np.float32] = np.zeros(ACTION_DIM, dtype=np.float32)
        self.prompt_shown: bool | None = None
        self.drifted = False
        self._wrong: list[Atom] = []
        self._expert: Expert | None = None
        self._blind: Iterator[NDArray[np.float32]] | None = None
        self._prompt: Prompt | None = None
        if self.demonstration_prompt or (task.prompt is not None and not task.prompt.restores):
            longest = PROMPT_HORIZON if task.prompt_steps is None else task.prompt_steps
            file = prompt_file(task, self.seed, self.scene_hash) if keep_prompt else None
            self._prompt = prompt_of(PromptDemonstrator(task, self.sim, self._rng(2)), self.sim, longest, file)
        if not self.demonstration_prompt:
            self._show_unseen()
        self._starts = first_execution_step(self.published, self.seed, self.demonstration_prompt)
        self._begin_if_due()

    def _show_unseen(self) -> None:
        """Play the prompt before the first frame: without it there would be nothing to find."""
        self.skip_prompt_frames()
        while self._prompt is not None:
            self._step_prompt()
        self.step_index = 0

    def skip_prompt_frames(self) -> None:
        """Leave out the frames of a kept prompt but its end: the caller reads none of them."""
        if self._prompt is not None:
            self._prompt.observed = False

    def _step_prompt(self) -> None:
        """Show the prompt's next step; when there is none, let the scene rest: nothing is simulated."""
        self.applied_action = np.zeros(ACTION_DIM, np.float32) if self._prompt is None else self._prompt.step()
        self.step_index += 1
        if self._prompt is not None and self._prompt.over:
            self._end_prompt(self._prompt)

    def _end_prompt(self, prompt: Prompt) -> None:
        """Put the scene back exactly as it was, unless something was hidden in it."""
        self.prompt_shown = prompt.shown
        self.sim.end_prompt(self._start, () if self.task.prompt is None else self.task.prompt.places)
        self._prompt = None

    def _begin_if_due(self) -> None:
        """Hand over to the policy, where prompt and rest are over."""
        if self._prompt is not None or self.step_index < self._starts:
            return
        self.sim.begin_execution()
        self.exec_start = self.step_index
        # What holds already, such as a thing on the plate that it is to leave, is no mistake.
        self._wrong = [atom for atom in _wrong_atoms(self.task) if not self.sim.holds(atom)]

    @property
    def phase(self) -> int:
        """`PROMPT` or `EXECUTION`."""
        return PROMPT if self.exec_start is None else EXECUTION

    @property
    def idling(self) -> bool:
        """Nothing moves until the execution begins: the prompt is over, or there is none."""
        return self.phase == PROMPT and self._prompt is None

    @property
    def still(self) -> bool:
        """The scene rests: the robot idles, or rested in a pause."""
        return self.idling or self.rested

    @property
    def clock(self) -> int:
        """Value of ``step`` in observations: control steps since the phase began; `NO_CLOCK` where a task idles.

        Where it idles the count begins with the episode and ends with the execution, which shows no clock.
        """
        if self.phase == PROMPT:
            return self.step_index
        if self.task.idles:
            return ENDED if self.done else NO_CLOCK
        return self.step_index - (self.exec_start or 0)

    @property
    def heeds(self) -> bool:
        """Whether the next action has an effect: none has during the prompt and in a pause."""
        return self.phase == EXECUTION and self.pacing.heeds

    @property
    def exec_steps(self) -> int:
        """Execution steps taken so far, without those of pauses."""
        return self.progress.steps

    @property
    def success(self) -> bool:
        """The goal holds now, and the policy has acted."""
        return self.phase == EXECUTION and self.progress.success

    @property
    def lost(self) -> bool:
        """The goal can no longer be reached; for strict tasks only; published ones run to their horizon."""
        return self.task.suite == STRICT and self.phase == EXECUTION and self.progress.lost

    @property
    def cut_off(self) -> bool:
        """The horizon ended it, and is shorter than the protocol's: what was missing might have come."""
        whole = UPSTREAM_HORIZON if self.settings.protocol == UPSTREAM else HORIZON
        return self.settings.horizon < whole and self.exec_steps >= self._limit and not (self.success or self.lost)

    @property
    def closed(self) -> bool:
        """All checkpoints have held, in whatever order: in the authors' evaluation that is the end."""
        first = self.progress.first_step
        return self.settings.protocol == UPSTREAM and bool(first) and None not in first

    @property
    def done(self) -> bool:
        """Ended by success, horizon, loss, fault or, in the authors' evaluation alone, satisfied checkpoints."""
        ended = self.success or self.lost or self.closed
        return ended or self.exec_steps >= self._limit or self.fault is not None

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Classes whose scans are not on this machine, so that others stand in for them in this scene."""
        return self.sim.stand_ins

    def step(self, action: ArrayLike) -> None:
        """Advance by one control step; during the prompt the given action has no effect, after a fault nothing has."""
        if self.phase == PROMPT:
            self._step_prompt()
            self._begin_if_due()
            return
        if self.fault is None:
            self.fault = self._act(action)
        if self.fault is not None:
            return
        self.step_index += 1
        if self.rested:
            return
        self.progress.step(self.sim.holds)
        if self.choice is not None:
            self.choice.step(self.sim.holds)
        self.drifted = self.drifted or any(self.sim.holds(atom) for atom in self._wrong)

    def _act(self, action: ArrayLike) -> Fault | None:
        """Carry out the action of the policy; return the fault, if any."""
        try:
            numbers = as_action(action, np.float32)  # before it is clipped: infinity would become 1
            moved = self.pacing.step(np.clip(numbers, -1.0, 1.0))
            self.rested = moved is None
            self.applied_action = NOTHING if moved is None else moved
            if moved is not None:
                self.sim.step(moved)
        except InvalidActionError as error:
            return Fault(INVALID_ACTION, str(error))
        except UnstablePhysicsError as error:
            return Fault(UNSTABLE_PHYSICS, str(error))
        return None

    def expert_action(self) -> NDArray[np.float32]:
        """Return what the scripted expert does now, (7,); zeros while it has no effect. Ask once per step."""
        if not self.heeds:
            return np.zeros(ACTION_DIM, dtype=np.float32)
        if self._expert is None:
            self._expert = Expert(self.task, self.sim, self._rng(3))
        return self._expert.act()

    def blind_action(self) -> NDArray[np.float32]:
        """Return what the published routine does now, blind to prompt and instruction, (7,).

        It is zeros while that has no effect. Ask once per step.
        """
        if not self.heeds:
            return np.zeros(ACTION_DIM, dtype=np.float32)
        if self._blind is None:
            routine = get_task(self.published.derived_from) if self.published.derived_from else self.published
            self._blind = blind_routine(routine, self.sim, self._rng(3))
        return np.clip(next(self._blind), -1.0, 1.0)

    @property
    def expert_done(self) -> bool:
        """The expert has gone through its plan; whatever does not hold by now it will not bring about."""
        return self._expert is not None and self._expert.done

    def objects(self) -> NDArray[np.float32]:
        """Return what both cameras see now as objects, (`sim.object_slots.SIZE`,)."""
        if self._slots is None:
            self._slots = ObjectSlots(self.sim)
        return self._slots.observe()

    def images(self) -> dict[str, Image]:
        """Return what both cameras see now, (256, 256, 3) uint8 each, upright."""
        return {key: self.sim.render(camera) for key, camera in CAMERAS.items()}

    def subgoal(self) -> str:
        """Return the instruction for the checkpoint being worked on; that of a task without checkpoints."""
        texts = subtask_texts(self.task)
        return texts[min(self.progress.index, len(texts) - 1)]


def referent_of(task: Task, seed: int) -> Task:
    """Return the variant of a task that a random referent shows in the episode of a seed.

    Variants are drawn in balance: from the first seed of a split on (`protocol.SPLITS`), every run of as many seeds as
    there are variants shows each of them once, in a new order. So each is right equally often, in a dataset as
    in an evaluation, and which one it is says nothing about where things stand.
    """
    if task.num_variants == 1:
        return task
    choices = task.random_variants
    first = max((split.start for split in SPLITS.values() if split.start <= seed), default=0)
    place = (seed - first) % len(choices)
    order = generator(task, seed - place, 1).permutation(choices)
    return task.variant(int(order[place]))


def first_execution_step(task: Task, seed: int, demonstration_prompt: bool) -> int:
    """Return the step at which the execution of a seed's episode begins, or 0: as soon as its prompt is over.

    The seed draws how long the robot idles, apart from the variant and all else.

    Args:
        task: as the catalogue has it, before a variant is drawn.
        demonstration_prompt: whether the prompt, where the task has one, is part of the episode.
    """
    if not task.idles:
        return 0
    prompt = (task.prompt_steps or 0) if demonstration_prompt else 0
    return prompt + int(generator(task, seed, 5).integers(IDLE_STEPS, endpoint=True))


def generator(task: Task, seed: int, stream: int) -> np.random.Generator:
    """A generator of its own for each use, so that one cannot shift the other's draws."""
    return np.random.default_rng([seed, zlib.crc32(task.name.encode()), stream])


def _wrong_atoms(task: Task) -> Iterator[Atom]:
    """Yield atoms that say that another answer was given than the prompt's: an object's, a target's or a place's.

    Of object and procedural tasks: a checkpoint in which another instance of the same class stands for an object or for
    its target, and those of the answers that another prompt would have shown. What this task's own checkpoints ask for
    is none, in whatever order.
    """
    if task.memory_type not in ("object", "procedural"):
        return
    asked = list(dict.fromkeys(atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)))
    others = [atom for k in range(task.num_variants) for one in task.variant(k).checkpoints for atom in atoms(one.goal)]
    for atom in dict.fromkeys([*(sibling for one in asked for sibling in _siblings(task, one)), *others]):
        if atom.predicate in ("on", "in") and atom not in asked:
            yield atom


def _siblings(task: Task, atom: Atom) -> Iterator[Atom]:
    """Yield an atom with another instance of the same class in one place."""
    for position, name in enumerate(atom.args):
        class_name = task.objects.get(name)
        for other, other_class in task.objects.items():
            if class_name is not None and other_class == class_name and other not in atom.args:
                yield Atom(atom.predicate, (*atom.args[:position], other, *atom.args[position + 1 :]))
