"""Evaluations made by hand, for tests of what is made of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import write_episodes


def rollout(
    task: str, memory_type: str, operations: str, done: Iterable[bool], success: bool, episode: int, **changes: Any
) -> dict[str, Any]:
    """A record; ``done`` says which checkpoints were satisfied, one step after another."""
    steps = [10 * (k + 1) if satisfied else None for k, satisfied in enumerate(done)]
    so_far = [all(step is not None for step in steps[: k + 1]) for k in range(len(steps))]
    return {
        "task": task,
        "memory_type": memory_type,
        "episode": episode,
        "seed": 7 + episode,
        "referent": "fixed",
        "replan_steps": 5,
        "success": success,
        "checkpoints": [
            {"operation": operation, "first_step": step, "ordered_step": step if before else None}
            for operation, step, before in zip(operations, steps, so_far, strict=True)
        ],
        "failure": None,
        "scene_hash": f"{task}-{episode}",
        **changes,
    }


def evaluation(folder: Path, successes: int = 2, episodes: int = 4, **changes: Any) -> Path:
    """A log of two tasks: the first ``successes`` episodes of each succeed, the others miss their last checkpoint."""
    records = [
        rollout(
            task, memory_type, operations, [True] * (len(operations) - 1) + [k < successes], k < successes, k, **changes
        )
        for task, memory_type, operations in (("one", "temporal", "SU"), ("two_of_them", "spatial", "SUC"))
        for k in range(episodes)
    ]
    write_episodes(folder, records)
    return folder
