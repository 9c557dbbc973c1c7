"""One demonstration: the scripted expert carries out a task from a seed, and what happens is kept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.dagger import Learner
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.writing import model_file
from lerobot_memobench.datasets.perturbation import Perturbation
from lerobot_memobench.datasets.staging import HDF5, LEROBOT, EpisodeStage, StagedJob, stage_failure
from lerobot_memobench.envs.episode import Episode, generator
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import EXECUTION, IMAGE_SIZE
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.tasks.task import Task

HOLD_FRAMES = 10
"""Frames kept after success: the last event has a frame, and the expert goes on with what it is at, so that a policy
which sees less exactly does not stop short of it."""

PERTURBATION = 4
"""Stream of the episode's random numbers that decides how the arm is moved off its way."""

PATIENCE = 40
"""Steps that an episode goes on after the expert is through with its plan: what still falls, slides or has to hold for
some steps may yet reach the goal. Then it is given up, long before the horizon."""

Images = dict[str, NDArray[np.uint8]]
"""Camera to a frame, (H, W, 3)."""


@dataclass(frozen=True)
class RecordingSettings:
    """Settings of a demonstration beside task and seed."""

    referent: str = "fixed"
    images: bool = True
    image_size: int = IMAGE_SIZE
    demonstration_prompt: bool = True
    hold_frames: int = HOLD_FRAMES
    perturb: bool = False
    policy: str | None = None


def record_demonstration(
    task: Task,
    seed: int,
    *,
    referent: str = "fixed",
    variant: int = 0,
    images: bool = True,
    demonstration_prompt: bool = True,
    hold_frames: int = HOLD_FRAMES,
    image_size: int = IMAGE_SIZE,
    perturb: bool = False,
    policy: str | None = None,
) -> Demonstration:
    """Let the scripted expert carry out a task from a seed.

    The result may be a failure (``success`` is False): it is then cut off at the horizon. With
    ``referent="random"`` the seed decides the variant; ``variant`` picks one when the referent is fixed.
    """
    if variant and referent != "fixed":
        raise MemobenchError(
            f"variant {variant} was asked for together with referent={referent!r}; choose variants with 'fixed' only"
        )
    settings = RecordingSettings(referent, images, image_size, demonstration_prompt, hold_frames, perturb, policy)
    return record(compiled_episode(task.variant(variant), settings), seed, settings)


@lru_cache(maxsize=1)
def compiled_episode(task: Task, settings: RecordingSettings) -> Episode:
    """Return an episode of a task, to be reset.

    The last task's scene stays compiled: a worker meets a task's seeds one after another.
    """
    size = settings.image_size
    return Episode(
        task,
        referent=settings.referent,
        demonstration_prompt=settings.demonstration_prompt,
        render=replace(RenderSettings(), width=size, height=size),
    )


def record(
    episode: Episode, seed: int, settings: RecordingSettings, show: Callable[[Images], None] | None = None
) -> Demonstration:
    """Record an episode. Images go to ``show``, frame by frame, or without it into the demonstration."""
    if settings.hold_frames < 1:
        raise MemobenchError(
            f"hold_frames is {settings.hold_frames}; the last event shows only with at least 1 frame after success"
        )
    episode.reset(seed)
    fixture_poses = episode.sim.fixture_poses()
    tape = _Tape()
    disturb = _disturbance(episode, seed, settings)
    reached = False
    held = idle = 0
    while held < settings.hold_frames:
        tape.take(episode)
        pictures = episode.images() if settings.images else None
        if isinstance(disturb, Learner):
            disturb.observe(episode, tape.objects[-1], pictures)
        if pictures is not None:
            (show or tape.keep)(pictures)
        reached = reached or episode.success
        idle += getattr(episode, "expert_done", False)
        over = reached or episode.done or idle > PATIENCE
        held += over
        wanted = episode.expert_action()
        acting = disturb is not None and episode.phase == EXECUTION
        done = wanted
        if disturb is not None and acting and not over:
            done = disturb.executed(wanted, episode.sim.at_detent)
        episode.step(done)
        tape.executed.append(episode.applied_action)
        tape.actions.append(np.clip(wanted, -1.0, 1.0) if acting else episode.applied_action)
    return tape.demonstration(episode, fixture_poses, success=reached and episode.prompt_shown is not False)


def _disturbance(episode: Episode, seed: int, settings: RecordingSettings) -> Perturbation | Learner | None:
    """Return the disturbance or the learner that moves the arm off the expert's way, if any."""
    rng = generator(episode.published, seed, PERTURBATION)
    if settings.policy is not None:
        return Learner(settings.policy, rng)
    return Perturbation(rng) if settings.perturb else None


@dataclass
class _Tape:
    """Columns of the frames so far."""

    states: list[NDArray[np.float64]] = field(default_factory=list)
    actions: list[NDArray[np.float32]] = field(default_factory=list)
    executed: list[NDArray[np.float32]] = field(default_factory=list)
    objects: list[NDArray[np.float32]] = field(default_factory=list)
    proprio: list[NDArray[np.float32]] = field(default_factory=list)
    satisfied: list[tuple[bool, ...]] = field(default_factory=list)
    images: dict[str, list[NDArray[np.uint8]]] = field(default_factory=dict)

    def take(self, episode: Episode) -> None:
        """Append the frame before the next action."""
        self.states.append(episode.sim.state())
        self.proprio.append(episode.sim.proprio())
        self.objects.append(episode.objects())
        self.satisfied.append(episode.progress.satisfied)

    def keep(self, images: Images) -> None:
        """Keep the cameras' frame."""
        for name, frame in images.items():
            self.images.setdefault(name, []).append(frame)

    def demonstration(
        self, episode: Episode, fixture_poses: dict[str, NDArray[np.float64]], *, success: bool
    ) -> Demonstration:
        """Return the whole, once the episode is over; the images are given away."""
        assert episode.exec_start is not None
        actions, executed = np.array(self.actions, dtype=np.float32), np.array(self.executed, dtype=np.float32)
        return Demonstration(
            task=episode.task,
            seed=episode.seed,
            referent=episode.referent,
            variant=episode.task.variant_index,
            states=np.array(self.states, dtype=np.float64),
            actions=actions,
            executed=None if np.array_equal(actions, executed) else executed,
            objects=np.array(self.objects, dtype=np.float32),
            proprio=np.array(self.proprio, dtype=np.float32),
            images={name: np.stack(self.images.pop(name)) for name in list(self.images)} if self.images else None,
            exec_start=episode.exec_start,
            satisfied=np.array(self.satisfied, dtype=np.bool_).reshape(len(self.states), len(episode.task.checkpoints)),
            success=success,
            fixture_poses=fixture_poses,
            scene_hash=episode.scene_hash,
        )


def _failure_reason(demo: Demonstration, episode: Episode) -> str | None:
    if episode.fault is not None:
        return episode.fault.why
    if episode.prompt_shown is False:
        return "the demonstration prompt did not show what it had to"
    if not demo.success:
        index, count = episode.progress.index, len(demo.task.checkpoints)
        steps = episode.progress.steps
        end = "and no longer to be" if episode.lost else "the expert's plan over"
        how = f"in {episode.horizon} steps" if steps >= episode.horizon else f"by step {steps}, {end}"
        return f"goal not reached {how} ({index} of {count} checkpoints completed)"
    return None


@dataclass(frozen=True)
class RecordingJob(StagedJob):
    """One seed of one task, to be recorded and staged in ``folder``."""

    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path
    formats: tuple[str, ...] = (LEROBOT,)

    @property
    def task_name(self) -> str:
        """The task's name."""
        return self.task.name

    def run(self) -> None:
        """Make the episode. Runs in any process; the folder is all that it leaves behind."""
        where = f"{self.task.name}, seed {self.seed}"
        try:
            episode = compiled_episode(self.task, self.settings)
            with EpisodeStage(self.folder, self.formats) as stage:
                demo = record(episode, self.seed, self.settings, stage.add_images)
                reason = _failure_reason(demo, episode)
                if reason is None:
                    if HDF5 in self.formats:
                        demo = replace(demo, model_xml=model_file(self.task, demo.fixture_poses))
                    stage.publish(demo)
                    return
        except MemobenchError as error:
            raise MemobenchError(f"{where}: {error}") from error
        except Exception as error:
            error.add_note(f"while recording {where}")
            raise
        stage_failure(_failed_info(demo), reason, self.folder)


def _failed_info(demo: Demonstration) -> dict[str, Any]:
    """What is kept of a seed without a demonstration."""
    return {
        "task_name": demo.task.name,
        "memory_type": demo.task.memory_type,
        "seed": demo.seed,
        "referent": demo.referent,
        "variant": demo.variant,
        "success": False,
        "frames": len(demo),
        "scene_hash": demo.scene_hash,
    }
