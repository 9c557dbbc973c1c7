"""Record one demonstration: the scripted expert carries out a task from a seed, perturbed if requested."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import EXECUTION, IMAGE_SIZE
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.stage import EpisodeStage, StagedJob, stage_failure
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.convention import UPRIGHT
from lerobot_memobench.sim.simulation import RenderSettings
from lerobot_memobench.tasks.task import Task

HOLD_FRAMES = 10
"""Frames recorded after success: the last event has a frame, and the expert completes its motion, so that a less exact
policy does not stop before it."""
PERTURBATION = 4
"""Stream of the episode's random numbers that draws perturbations."""
PATIENCE = 40
"""Steps, without held ones, that an episode continues after the expert has finished its plan: falling or sliding
objects, and formulas that must hold for some steps, may still reach the goal. Then it is given up, long before the
horizon."""

Images = dict[str, NDArray[np.uint8]]
"""Camera to a frame, (H, W, 3)."""


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of a demonstration besides task and seed.

    Attributes:
        referent: ``"fixed"``, the task's own goal, or ``"random"``, the seed's; of a strict task ``"drawn"``.
        image_size: height and width of images, pixels.
        demonstration_prompt: whether the episode begins with the task's prompt, if it has one.
        perturb: whether the arm is moved off its way at random (`Perturbation`).
        convention: in which the images are written (`sim.convention`).
    """

    referent: str = "fixed"
    images: bool = True
    image_size: int = IMAGE_SIZE
    demonstration_prompt: bool = True
    perturb: bool = False
    convention: str = UPRIGHT


@lru_cache(maxsize=1)
def compiled_episode(task: Task, settings: RecordingSettings) -> Episode:
    """Return an episode of a task, to be reset; the last one is cached, because a task's seeds follow each other."""
    return Episode(
        task,
        suite=task.suite,
        referent=settings.referent,
        demonstration_prompt=settings.demonstration_prompt,
        render=replace(RenderSettings(), width=settings.image_size, height=settings.image_size),
    )


def record(episode: Episode, seed: int, settings: RecordingSettings, show: Callable[[Images], object]) -> Demonstration:
    """Record an episode without images; ``show`` is called with the images of each frame."""
    episode.reset(seed)
    sim, fixture_poses = episode.sim, episode.sim.fixture_poses()
    frames: list[tuple[NDArray, NDArray, NDArray, NDArray, bool]] = []
    actions, executed = [], []
    disturb = Perturbation(generator(episode.published, seed, PERTURBATION)) if settings.perturb else None
    reached = rests = False
    after = idle = 0
    images: Images | None = None
    while after < HOLD_FRAMES:
        if not (episode.rested or (rests and episode.idling)):  # a scene at rest is observed once
            state, hand, seen = sim.state(), sim.proprio(), episode.objects()
            images = episode.images() if settings.images else None
        rests = episode.idling
        is_held = episode.phase == EXECUTION and not episode.action_has_effect
        frames.append((state, hand, seen, np.array(episode.progress.satisfied, np.bool_), is_held))
        if images is not None:
            show(images)
        reached = reached or episode.success
        idle += episode.expert_done and not is_held
        over = reached or episode.done or idle > PATIENCE
        after += over
        wanted = episode.expert_action()
        acting = disturb is not None and episode.action_has_effect
        disturbed = disturb.executed(wanted, sim.at_detent) if disturb is not None and acting and not over else wanted
        episode.step(disturbed)
        executed.append(episode.applied_action)
        actions.append(np.clip(wanted, -1.0, 1.0) if acting else episode.applied_action)
    assert episode.exec_start is not None
    states, proprio, objects, satisfied, held = map(np.array, zip(*frames, strict=True))
    labelled, applied = (np.array(column, dtype=np.float32) for column in (actions, executed))
    return Demonstration(
        task=episode.task,
        seed=episode.seed,
        referent=episode.referent,
        variant=episode.task.variant_index,
        states=states.astype(np.float64),
        actions=labelled,
        executed=None if np.array_equal(labelled, applied) else applied,
        objects=objects.astype(np.float32),
        proprio=proprio.astype(np.float32),
        images=None,
        exec_start=episode.exec_start,
        satisfied=satisfied,
        success=reached and episode.prompt_shown is not False,
        fixture_poses=fixture_poses,
        scene_hash=episode.scene_hash,
        stand_ins=episode.stand_ins,
        held=held if held.any() else None,
    )


def _failure_reason(demo: Demonstration, episode: Episode) -> str | None:
    if episode.fault is not None:
        return episode.fault.why
    if episode.prompt_shown is False:
        return "the demonstration prompt was incomplete"
    if demo.success:
        return None
    steps = episode.progress.steps
    end = "and no longer to be" if episode.lost else "the expert's plan over"
    how = f"in {episode.settings.horizon} steps" if steps >= episode.settings.horizon else f"by step {steps}, {end}"
    completed = f"{episode.progress.index} of {len(demo.task.checkpoints)} checkpoints completed"
    return f"goal not reached {how} ({completed})"


@dataclass(frozen=True)
class RecordingJob(StagedJob):
    """Record one seed of one task and stage it in ``folder``."""

    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path

    @property
    def task_name(self) -> str:
        """The task's name, for the progress."""
        return self.task.name

    def run(self) -> None:
        """Make the episode; the folder is the only output."""
        where = f"{self.task.name}, seed {self.seed}"
        try:
            episode = compiled_episode(self.task, self.settings)
            with EpisodeStage(self.folder, self.settings.convention) as stage:
                demo = record(episode, self.seed, self.settings, stage.add_images)
                reason = _failure_reason(demo, episode)
                if reason is None:
                    stage.publish(demo)
                    return
        except MemobenchError as error:
            raise MemobenchError(f"{where}: {error}") from error
        except Exception as error:
            error.add_note(f"while recording {where}")
            raise
        info = {"task_name": demo.task.name, "seed": demo.seed, "referent": demo.referent, "variant": demo.variant}
        info |= {"success": False, "frames": len(demo), "scene_hash": demo.scene_hash}
        stage_failure(info, reason, self.folder)


# --- perturbation ---
#
# Recovery data: the arm is moved off its way at random, and the closed-loop expert corrects it. The labels of a frame
# are the expert's actions; the executed ones are kept for replay.
# Pushes are standard deviations of an action's six displacements, per step (1 is 5 cm or 0.5 rad); ranges of steps
# exclude their end.

CLEAN = 1 / 3  # share of unperturbed episodes
NOISE = 0.05  # standard deviation on each displacement
PUSH_CHANCE = 0.02  # per step
PUSH, PUSH_STEPS = np.array([0.6, 0.6, 0.6, 0.1, 0.1, 0.3]), (3, 8)  # turns mostly about the vertical
MISS_CHANCE = 0.2
"""Probability that the hand is pushed away when its fingers begin to close: they close on air, and the expert returns.
A policy trained without such frames carries an empty hand to the target."""
MISS, MISS_SPREAD = np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0]), np.array([0.25, 0.25, 0.25, 0.0, 0.0, 0.0])  # upwards
MISS_STEPS = (6, 10)  # about as long as fingers take to close
TWIST_CHANCE = 0.15
"""Probability that the hand is first turned with open fingers, which then stop at another width than along a side. A
policy trained without such frames waits for them to close further."""
TWIST, TWIST_STEPS = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25]), (3, 6)
DROP_CHANCE = 0.05
DROP_AFTER, DROP_STEPS = (15, 50), 8
"""A grasped object is dropped on its way so many steps after closing, for so many steps."""
LATE_CHANCE, LATE_STEPS = 0.2, (3, 16)
"""Fingers stay closed for so many steps when they should open. A policy trained without such frames waits forever
instead of opening."""
COMING_TO_REST = 0.4  # of a displacement at the home detent with which the expert intends to rest there (2 cm)

Array = NDArray[np.float64]


class Perturbation:
    """Perturb the actions of one episode; a function of the generator's numbers only."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._clean = rng.random() < CLEAN
        self._left = 0
        self._push: Array = np.zeros(6)
        self._closed = 0  # steps since the command to close the fingers
        self._open = range(0)  # values of _closed at which they are opened
        self._late = 0  # remaining steps in which they stay closed although they should open

    def executed(self, action: NDArray[np.float32], at_detent: bool = False) -> NDArray[np.float32]:
        """Return the action (7,) to execute instead of the expert's. Call once per step.

        ``at_detent``, in the detent at home, small actions are not perturbed: the hand would never come to rest.
        """
        if self._clean or (at_detent and np.abs(action[:6]).max() <= COMING_TO_REST):
            return action
        opens = self._closed > 0 and action[6] < 0
        self._closed = self._closed + 1 if action[6] > 0 else 0
        if opens:
            self._late = int(self._rng.integers(*LATE_STEPS)) if self._rng.random() < LATE_CHANCE else 0
        if self._closed == 1:
            self._grasp()
        elif not self._left and self._rng.random() < PUSH_CHANCE:
            self._begin(PUSH * self._rng.normal(size=6), PUSH_STEPS)
        executed = action.astype(np.float64)
        executed[:6] += NOISE * self._rng.normal(size=6)
        if self._left:
            executed[:6] += self._push
            self._left -= 1
        if self._closed in self._open:
            executed[6] = -1.0
        elif self._late and action[6] < 0:
            executed[6] = 1.0
            self._late -= 1
        return executed.astype(np.float32)

    def _grasp(self) -> None:
        self._open = range(0)
        draw = self._rng.random()
        if draw < MISS_CHANCE:
            self._begin(MISS + MISS_SPREAD * self._rng.normal(size=6), MISS_STEPS)
        elif draw < MISS_CHANCE + TWIST_CHANCE:
            self._begin(TWIST * self._rng.normal(size=6), TWIST_STEPS)
            self._open = range(1, self._left + 1)
        elif draw < MISS_CHANCE + TWIST_CHANCE + DROP_CHANCE:
            first = int(self._rng.integers(*DROP_AFTER))
            self._open = range(first, first + DROP_STEPS)

    def _begin(self, push: Array, steps: tuple[int, int]) -> None:
        self._push, self._left = push, int(self._rng.integers(*steps))
