"""What the log keeps of a finished episode."""

from __future__ import annotations

from typing import Any

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.tasks.failures import classify_failure
from lerobot_memobench.tasks.task import PUBLISHED, Task


def episode_record(episode: Episode, *, seed_base: int, replan_steps: int | None, wall_s: float) -> dict[str, Any]:
    """Return an episode's line for the log (`docs/evaluate.md` tells its fields).

    Args:
        seed_base: the seed that counts as episode 0.
        replan_steps: actions that the policy executes per prediction, where it is known.
        wall_s: seconds that the episode took.
    """
    progress, task, fault = episode.progress, episode.task, episode.fault
    failure = classify_failure(
        task,
        progress.first_step,
        episode.success,
        drift=episode.drifted,
        lost=episode.lost,
        cut_off=episode.cut_off,
    )
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": episode.seed - seed_base,
        "seed": episode.seed,
        "referent": episode.referent,
        "variant": task.variant_index,
        "replan_steps": replan_steps,
        "prompt_steps": episode.exec_start if episode.exec_start is not None else episode.step_index,
        "prompt_shown": episode.prompt_shown,
        "steps": episode.exec_steps,
        "success": episode.success,
        "checkpoints": [
            {"operation": checkpoint.operation, "first_step": first, "ordered_step": ordered}
            for checkpoint, first, ordered in zip(
                task.checkpoints, progress.first_step, progress.ordered_step, strict=True
            )
        ],
        "failure": failure if fault is None else fault.failure,
        **({} if fault is None else {"fault": fault.why}),
        **({} if task.suite == PUBLISHED else {"suite": task.suite, "lost": episode.lost}),
        "scene_hash": episode.scene_hash,
        "wall_s": round(wall_s, 3),
    }


def not_run_record(task: Task, seed: int, *, seed_base: int, referent: str, why: str) -> dict[str, Any]:
    """Return the line for the log of an episode that could not be run."""
    return {
        "task": task.name,
        "memory_type": task.memory_type,
        "episode": seed - seed_base,
        "seed": seed,
        "referent": referent,
        "success": False,
        "checkpoints": [],
        **({} if task.suite == PUBLISHED else {"suite": task.suite}),
        "not_run": why,
    }
