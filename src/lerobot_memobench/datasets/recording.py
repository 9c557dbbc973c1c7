"""One demonstration: the scripted expert carries out a task from a seed, and everything is recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.perturbation import Perturbation
from lerobot_memobench.datasets.staging import EpisodeStage, StagedJob, stage_failure
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
    """Settings of a demonstration besides task and seed.

    Attributes:
        referent: ``"fixed"``, the task's own goal, or ``"random"``, the seed's; of a strict task ``"drawn"``.
        images: whether the cameras are recorded. image_size: their height and width, pixels.
        demonstration_prompt: whether the episode begins with the prompt, where the task has one.
        perturb: move the arm off its way at random (`datasets.perturbation`).
    """

    referent: str = "fixed"
    images: bool = True
    image_size: int = IMAGE_SIZE
    demonstration_prompt: bool = True
    perturb: bool = False


def record_demonstration(task: Task, seed: int, *, variant: int = 0, **settings: Any) -> Demonstration:
    """Let the scripted expert carry out a task from a seed.

    The result may be a failure (``success`` is False): it is then cut off at the horizon. With
    ``referent="random"`` the seed decides the variant; ``variant`` picks one when the referent is fixed.

    Args:
        settings: fields of `RecordingSettings`.
    """
    chosen = RecordingSettings(**settings)
    if variant and chosen.referent != "fixed":
        raise MemobenchError(
            f"variant {variant} was asked for together with referent={chosen.referent!r}; choose variants with 'fixed' "
            "only"
        )
    shown: list[Images] = []
    demo = record(compiled_episode(task.variant(variant), chosen), seed, chosen, shown.append)
    if not shown:
        return demo
    return replace(demo, images={name: np.stack([images[name] for images in shown]) for name in shown[0]})


@lru_cache(maxsize=1)
def compiled_episode(task: Task, settings: RecordingSettings) -> Episode:
    """Return an episode of a task, to be reset.

    The last task's scene stays compiled: a worker meets a task's seeds one after another.
    """
    return Episode(
        task,
        suite=task.suite,
        referent=settings.referent,
        demonstration_prompt=settings.demonstration_prompt,
        render=replace(RenderSettings(), width=settings.image_size, height=settings.image_size),
    )


def record(episode: Episode, seed: int, settings: RecordingSettings, show: Callable[[Images], object]) -> Demonstration:
    """Record an episode; its images go to ``show``, frame by frame, and not into the demonstration."""
    episode.reset(seed)
    sim, fixture_poses = episode.sim, episode.sim.fixture_poses()
    states, proprio, objects, satisfied, actions, executed = [], [], [], [], [], []
    disturb = Perturbation(generator(episode.published, seed, PERTURBATION)) if settings.perturb else None
    reached = rests = False
    held = idle = 0
    images: Images | None = None
    while held < HOLD_FRAMES:
        if not (rests and episode.idling):  # a scene at rest is observed once
            state, hand, seen = sim.state(), sim.proprio(), episode.objects()
            images = episode.images() if settings.images else None
        rests = episode.idling
        states.append(state)
        proprio.append(hand)
        objects.append(seen)
        satisfied.append(episode.progress.satisfied)
        if images is not None:
            show(images)
        reached = reached or episode.success
        idle += episode.expert_done
        over = reached or episode.done or idle > PATIENCE
        held += over
        wanted = episode.expert_action()
        acting = disturb is not None and episode.phase == EXECUTION
        done = wanted
        if disturb is not None and acting and not over:
            done = disturb.executed(wanted, sim.at_detent)
        episode.step(done)
        executed.append(episode.applied_action)
        actions.append(np.clip(wanted, -1.0, 1.0) if acting else episode.applied_action)
    assert episode.exec_start is not None
    labelled, applied = (np.array(found, dtype=np.float32) for found in (actions, executed))
    return Demonstration(
        task=episode.task,
        seed=episode.seed,
        referent=episode.referent,
        variant=episode.task.variant_index,
        states=np.array(states, dtype=np.float64),
        actions=labelled,
        executed=None if np.array_equal(labelled, applied) else applied,
        objects=np.array(objects, dtype=np.float32),
        proprio=np.array(proprio, dtype=np.float32),
        images=None,
        exec_start=episode.exec_start,
        satisfied=np.array(satisfied, dtype=np.bool_).reshape(len(states), len(episode.task.checkpoints)),
        success=reached and episode.prompt_shown is not False,
        fixture_poses=fixture_poses,
        scene_hash=episode.scene_hash,
        stand_ins=episode.stand_ins,
    )


def _failure_reason(demo: Demonstration, episode: Episode) -> str | None:
    if episode.fault is not None:
        return episode.fault.why
    if episode.prompt_shown is False:
        return "the demonstration prompt did not show what it had to"
    if demo.success:
        return None
    steps = episode.progress.steps
    end = "and no longer to be" if episode.lost else "the expert's plan over"
    how = f"in {episode.settings.horizon} steps" if steps >= episode.settings.horizon else f"by step {steps}, {end}"
    completed = f"{episode.progress.index} of {len(demo.task.checkpoints)} checkpoints completed"
    return f"goal not reached {how} ({completed})"


@dataclass(frozen=True)
class RecordingJob(StagedJob):
    """One seed of one task, to be recorded and staged in ``folder``."""

    task: Task
    seed: int
    settings: RecordingSettings
    folder: Path

    @property
    def task_name(self) -> str:
        """The task's name."""
        return self.task.name

    def run(self) -> None:
        """Make the episode. Runs in any process; the folder is all that it leaves behind."""
        where = f"{self.task.name}, seed {self.seed}"
        try:
            episode = compiled_episode(self.task, self.settings)
            with EpisodeStage(self.folder) as stage:
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
        stage_failure(_failed_info(demo), reason, self.folder)


def _failed_info(demo: Demonstration) -> dict[str, Any]:
    """Return the fields that are kept of a seed without a demonstration."""
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
