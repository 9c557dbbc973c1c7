"""An episode of one seed: settle the scene, play the prompt, execute the policy's actions, track progress.

The gymnasium environment and the recorder of demonstrations share this class, so datasets and observations at
evaluation agree.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lerobot_memobench.constants import (
    ACTION_DIM,
    CAMERAS,
    ENDED,
    EXECUTION,
    HOLD_MEAN,
    HOLD_SHAPE,
    LONGEST_HOLD,
    MOST_HOLDS,
    NO_CLOCK,
    PROMPT,
    PROMPT_HORIZON,
    SPLITS,
    UPSTREAM,
    UPSTREAM_EVALUATIONS,
    UPSTREAM_HORIZON,
)
from lerobot_memobench.envs.pacing import Pacing
from lerobot_memobench.envs.prompts import PromptPlayer, prompt_file, prompt_player
from lerobot_memobench.envs.settings import DEFAULTS, INTACT, EnvSettings, steps_per_action
from lerobot_memobench.experts.expert import Expert, PromptDemonstrator, blind_routine
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import (
    InvalidActionError,
    RenderSettings,
    Simulation,
    UnstablePhysicsError,
    as_action,
)
from lerobot_memobench.tasks.assessment import INVALID_ACTION, UNSTABLE_PHYSICS, Choice
from lerobot_memobench.tasks.catalogue import get_task, initial_states
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.memory_text import subtask_texts
from lerobot_memobench.tasks.progress import AS_BEGUN, Progress
from lerobot_memobench.tasks.task import LIBERO_SUITES, STRICT, Task, referent_text
from mujoco_raster.drawlist import Image


class Fault(NamedTuple):
    """Reason of an aborted execution: one of `tasks.assessment.FAULTS`, and a sentence."""

    failure: str
    why: str


class Episode:
    """An episode of one task; `reset` starts it for a seed.

    ``render``: size and quality of frames, None for those of ``settings``. ``changes`` replace settings by name.
    """

    def __init__(
        self, task: Task, settings: EnvSettings = DEFAULTS, *, render: RenderSettings | None = None, **changes: Any
    ) -> None:
        self.settings = settings = settings.changed(**changes)
        render = render or RenderSettings(settings.observation_height, settings.observation_width, settings.render)
        self.published = task = task.at(settings.difficulty)
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
        """Start the episode of a seed. The episode is a function of task, settings, seed and actions.

        ``variant`` replaces the drawn one (evidence), and `choice` follows the policy's. ``keep_prompt``: cache it.
        """
        self.seed = int(seed)
        self.fault: Fault | None = None  # reason of an aborted execution
        if variant is None:
            drawn = self.referent != "fixed"
            task = referent_of(self.published, self.seed, self.settings.salt) if drawn else self.published
        else:
            task = self.published.variant(variant)
        self.task = task  # a variant if the referent is drawn
        self.choice = None if variant is None else Choice(task)  # the variant that the policy acts on (evidence)
        # Checkpoints and goal, in execution steps.
        if self.settings.rules == UPSTREAM:
            self.progress = Progress(task, UPSTREAM_EVALUATIONS)
            self.sim.reset(self.seed, self.progress.settle)
        else:
            self.progress = Progress(task)
            state: NDArray[np.float64] | None = None
            if self.published.suite in LIBERO_SUITES:
                states = initial_states(self.published.name)
                state = states[(self.seed - self.settings.seed_base) % len(states)]  # begin again, as in LeRobot
            self.sim.reset(self.seed, state=state)
        self.scene_hash = self.sim.scene_hash()
        self._start = self.sim.snapshot()
        self.step_index = 0  # control steps since the start of the episode, including the prompt
        self.exec_start: int | None = None  # first frame of the execution
        self.pacing = Pacing(self.settings, self._rng(4))
        self.rested = False  # whether the last step was part of a pause or a hold: only the clock advanced
        self._event, self._holds = False, self.draw_holds()
        self.applied_action: NDArray[np.float32] = np.zeros(ACTION_DIM, np.float32)  # in the last step
        self.prompt_shown: bool | None = None  # whether the prompt has succeeded
        self.drifted = False  # whether one of the wrong atoms has held
        self._wrong_atoms: list[Atom] = []
        self._expert: Expert | None = None
        self._blind: Iterator[NDArray[np.float32]] | None = None
        self._prompt: PromptPlayer | None = None
        self._reshows = self.settings.reshow
        # Whether the memory is corrupted before the policy observes this frame, and whether it has been.
        self.corrupts = self.corrupted = False
        # Whether other episodes are shown now, and whether some follow the prompt.
        self.waits, self._interrupts = False, self.settings.interference > 0
        self._keeps_prompt = keep_prompt
        if self.demonstration_prompt or (task.prompt is not None and not task.prompt.restores):
            self._prompt = self._new_prompt()
        if not self.demonstration_prompt:
            # Objects that the prompt hides are hidden although it is not shown.
            self.skip_prompt_frames()
            while self._prompt is not None:
                self._step_prompt()
            self.step_index = 0
        self._execution_step = (self.published.prompt_steps or 0) if self.demonstration_prompt else 0
        self._begin_if_due()

    def draw_holds(self) -> Iterator[int]:
        """Return the lengths of the episode's holds."""
        rng = generator(self.published, self.seed, 5, self.settings.salt)  # not of the variant
        drawn = rng.gamma(HOLD_SHAPE, HOLD_MEAN / HOLD_SHAPE, MOST_HOLDS)
        if self.published.prompt is None:
            # By the law of the others a policy with a clock would count to one in 80 % (docs/benchmark/suites.md).
            drawn[0] = rng.uniform(0, LONGEST_HOLD)
        return iter(np.ceil(np.minimum(drawn, LONGEST_HOLD)).astype(int).tolist())

    def _new_prompt(self) -> PromptPlayer:
        longest = PROMPT_HORIZON if self.task.prompt_steps is None else self.task.prompt_steps
        file = prompt_file(self.task, self.seed, self.scene_hash) if self._keeps_prompt else None
        return prompt_player(PromptDemonstrator(self.task, self.sim, self._rng(2)), self.sim, longest, file)

    def skip_prompt_frames(self) -> None:
        """Restore only the end of a cached prompt, because its frames are not read."""
        if self._prompt is not None:
            self._prompt.observed = False

    def _step_prompt(self) -> None:
        self.applied_action = np.zeros(ACTION_DIM, np.float32) if self._prompt is None else self._prompt.step()
        self.step_index += 1
        if self._prompt is None or not self._prompt.over:  # after its end the scene rests until the execution begins
            return
        self.prompt_shown = self._prompt.succeeded
        if self._reshows:
            self._reshows = False
            self.sim.end_prompt(self._start)
            self._execution_step += self.step_index
            self._prompt = self._new_prompt()
            self._corrupt_at(0)
            return
        self.sim.end_prompt(self._start, () if self.task.prompt is None else self.task.prompt.places)
        self._prompt = None
        self.waits = self._interrupts

    def wait(self, last: bool = False) -> None:
        """Advance the clock while another episode is shown (`env.Interference`); ``last``: no other follows."""
        self.step_index += 1
        self._execution_step += 1
        self.waits = not last
        self._begin_if_due()

    def _corrupt_at(self, step: int) -> None:
        settings = self.settings
        due = settings.corrupt != INTACT and step == settings.corrupt_step and not self.corrupted
        self.corrupts, self.corrupted = due, self.corrupted or due

    def _begin_if_due(self) -> None:
        if self._prompt is not None or self.waits or self.step_index < self._execution_step:
            return
        self.sim.begin_execution()
        self.exec_start = self.step_index
        if self.task.suite == STRICT:
            self.progress.settle(self.sim.holds)  # the start counts as an arrival
            self.pacing.hold(next(self._holds))
        self._corrupt_at(0)
        # A wrong atom that already holds, such as an object on the plate, is not a mistake of the policy.
        self._wrong_atoms = [atom for atom in _wrong_atoms(self.task) if not self.sim.holds(atom)]

    @property
    def phase(self) -> int:
        """`PROMPT` or `EXECUTION`."""
        return PROMPT if self.exec_start is None else EXECUTION

    @property
    def idling(self) -> bool:
        """Whether the prompt has ended and the execution has not started: strict prompts have a fixed length."""
        return self.phase == PROMPT and self._prompt is None and not self.waits

    @property
    def at_rest(self) -> bool:
        """Whether the scene rests, while idling, in a pause or in a hold."""
        return self.idling or self.rested

    @property
    def clock(self) -> int:
        """Value of ``step`` in observations: steps since the phase began; in a strict execution `NO_CLOCK`, `ENDED`."""
        if self.phase == PROMPT:
            return self.step_index
        if self.task.suite == STRICT:
            return ENDED if self.done else NO_CLOCK
        return self.step_index - (self.exec_start or 0)

    @property
    def action_has_effect(self) -> bool:
        """Whether the next action is executed; actions in the prompt, in a pause and in a hold are not."""
        return self.phase == EXECUTION and self.pacing.action_has_effect

    @property
    def exec_steps(self) -> int:
        """Execution steps so far, without pauses and holds."""
        return self.progress.steps

    @property
    def success(self) -> bool:
        """Whether the goal holds now, in the execution."""
        return self.phase == EXECUTION and self.progress.success

    @property
    def lost(self) -> bool:
        """Whether the goal of a strict task is unreachable; published tasks run to the horizon."""
        return self.task.suite == STRICT and self.phase == EXECUTION and self.progress.lost

    @property
    def cut_off(self) -> bool:
        """Whether a horizon below the protocol's ended the episode."""
        whole = UPSTREAM_HORIZON if self.settings.rules == UPSTREAM else self.settings.usual["horizon"]
        return self.settings.horizon < whole and self.exec_steps >= self._limit and not (self.success or self.lost)

    @property
    def checkpoints_satisfied(self) -> bool:
        """Whether all checkpoints have held, in any order; this ends an episode of the authors' evaluation only."""
        first = self.progress.first_step
        return self.settings.rules == UPSTREAM and bool(first) and None not in first

    @property
    def done(self) -> bool:
        """Whether the episode has ended: success, horizon, fault, unreachable goal or `checkpoints_satisfied`."""
        ended = self.success or self.lost or self.checkpoints_satisfied
        return ended or self.exec_steps >= self._limit or self.fault is not None

    @property
    def stand_ins(self) -> tuple[str, ...]:
        """Classes whose scans are missing on this machine; this package's objects replace them in this scene."""
        return self.sim.stand_ins

    def step(self, action: ArrayLike) -> None:
        """Advance by one control step. The action has no effect in the prompt; after a fault the step has none."""
        self.corrupts = False
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
        self._event = self._event or self.progress.event
        # Returns without an event are not held: a policy with a clock could use them to time its next event.
        if self._event and self.sim.caught_at_home and self.sim.holds(AS_BEGUN):
            self.pacing.hold(next(self._holds, 0))
            self._event = False
        self._corrupt_at(self.exec_steps)
        if self.choice is not None:
            self.choice.step(self.sim.holds)
        self.drifted = self.drifted or any(self.sim.holds(atom) for atom in self._wrong_atoms)

    def _act(self, action: ArrayLike) -> Fault | None:
        try:
            numbers = as_action(action, np.float32)  # before clipping, which turns infinity into 1
            moved = self.pacing.step(np.clip(numbers, -1.0, 1.0))
            self.rested = moved is None
            self.applied_action = np.zeros(ACTION_DIM, np.float32) if moved is None else moved
            if moved is not None:
                self.sim.step(moved)
        except InvalidActionError as error:
            return Fault(INVALID_ACTION, str(error))
        except UnstablePhysicsError as error:
            return Fault(UNSTABLE_PHYSICS, str(error))
        return None

    def expert_action(self) -> NDArray[np.float32]:
        """Return the scripted expert's action (7,), zeros while actions have no effect. Call once per step."""
        if not self.action_has_effect:
            return np.zeros(ACTION_DIM, dtype=np.float32)
        if self._expert is None:
            self._expert = Expert(self.task, self.sim, self._rng(3))
        return self._expert.act()

    def blind_action(self) -> NDArray[np.float32]:
        """Return the action (7,) of the published routine, without prompt and instruction; see `expert_action`."""
        if not self.action_has_effect:
            return np.zeros(ACTION_DIM, dtype=np.float32)
        if self._blind is None:
            routine = get_task(self.published.derived_from) if self.published.derived_from else self.published
            self._blind = blind_routine(routine, self.sim, self._rng(3))
        return np.clip(next(self._blind), -1.0, 1.0)

    @property
    def expert_done(self) -> bool:
        """Whether the expert has completed its plan."""
        return self._expert is not None and self._expert.done

    def objects(self) -> NDArray[np.float32]:
        """Return the objects that at least one camera sees, (`sim.object_layout.SIZE`,) float32."""
        if self._slots is None:
            self._slots = ObjectSlots(self.sim)
        return self._slots.observe()

    def images(self) -> dict[str, Image]:
        """Render both cameras, (height, width, 3) uint8 each, upright."""
        return dict(zip(CAMERAS, self.sim.render_cameras([*CAMERAS.values()]), strict=True))

    def subgoal(self) -> str:
        """Return the instruction for the next checkpoint; the task's instruction without checkpoints."""
        texts = subtask_texts(self.task)
        return texts[min(self.progress.index, len(texts) - 1)]


def referent_of(task: Task, seed: int, salt: str | None = None) -> Task:
    """Return the variant of a task that the seed draws.

    Draws are balanced: from the first seed of a split (`constants.SPLITS`), each block of as many seeds as variants
    contains every variant once, in random order; ``salt`` (`EnvSettings.salt`) changes the order. All variants are
    equally frequent and independent of the layout.
    """
    if task.num_variants == 1:
        return task
    choices = task.random_variants
    first = max((split.start for split in SPLITS.values() if split.start <= seed), default=0)
    position = (seed - first) % len(choices)
    order = generator(task, seed - position, 1, salt).permutation(choices)
    return task.variant(int(order[position]))


def generator(task: Task, seed: int, stream: int, salt: str | None = None) -> np.random.Generator:
    """Return an independent generator per stream, so that streams cannot shift each other's draws."""
    salted = [int(f"1{salt}", 16)] if salt else []  # numpy ignores zeros at the end
    return np.random.default_rng([seed, zlib.crc32(task.name.encode()), stream, *salted])


def _wrong_atoms(task: Task) -> Iterator[Atom]:
    # Atoms after a wrong answer: a checkpoint's with another instance of the same class, and those of other variants.
    if task.memory_type not in ("object", "procedural"):
        return
    own = list(dict.fromkeys(atom for checkpoint in task.checkpoints for atom in atoms(checkpoint.goal)))
    siblings = [
        Atom(atom.predicate, (*atom.args[:position], other, *atom.args[position + 1 :]))
        for atom in own
        for position, name in enumerate(atom.args)
        for other in task.objects
        if other not in atom.args and task.objects[other] == task.objects.get(name)
    ]
    variant_atoms = [
        atom
        for k in range(task.num_variants)
        for checkpoint in task.variant(k).checkpoints
        for atom in atoms(checkpoint.goal)
    ]
    for atom in dict.fromkeys([*siblings, *variant_atoms]):
        if atom.predicate in ("on", "in") and atom not in own:
            yield atom
