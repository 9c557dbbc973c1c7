"""Evaluations made by hand, for tests of what is made of them."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import write_episodes

Mark = tuple[str, int | None, int | None]
"""A checkpoint of a rollout: operation, first step, ordered step."""
SETTINGS: dict[str, Any] = {
    "seed_base": 7,
    "referent": "fixed",
    "demonstration_prompt": True,
    "horizon": 1200,
    "replan_steps": None,
    "render": "default",
    "render_every": 1,
    "oracle_memory": False,
}
"""A protocol, as an environment writes it beside a log."""


def record(
    task: str = "a_task", episode: int = 0, marks: Iterable[Mark] = (("S", 3, 3),), **changes: Any
) -> dict[str, Any]:
    """A successful rollout; ``marks`` are its checkpoints."""
    return {
        "task": task,
        "memory_type": "temporal",
        "episode": episode,
        "seed": 7 + episode,
        "referent": "fixed",
        "replan_steps": 5,
        "success": True,
        "checkpoints": [
            {"operation": operation, "first_step": first, "ordered_step": ordered}
            for operation, first, ordered in marks
        ],
        "failure": None,
        "world": "libero",
        **changes,
    }


def rollout(
    task: str, memory_type: str, operations: str, done: Iterable[bool], success: bool, episode: int, **changes: Any
) -> dict[str, Any]:
    """A record; ``done`` says which checkpoints were satisfied, one step after another."""
    steps = [10 * (k + 1) if satisfied else None for k, satisfied in enumerate(done)]
    so_far = [all(step is not None for step in steps[: k + 1]) for k in range(len(steps))]
    ordered = [step if before else None for step, before in zip(steps, so_far, strict=True)]
    own = {"memory_type": memory_type, "success": success, "scene_hash": f"{task}-{episode}"}
    return record(task, episode, zip(operations, steps, ordered, strict=True), **own | changes)


MISSING = "missing: {} of {} episodes, the first is {}, episode {}"
"""The beginning of the note on missing episodes: how many, of how many, task and number."""


def evaluation(folder: Path, successes: int = 2, episodes: int = 4, first_seed: int = 7, **changes: Any) -> Path:
    """A log of two tasks: the first ``successes`` episodes of each succeed, the others miss their last checkpoint."""
    records = [
        rollout(
            *(task, memory_type, operations, [True] * (len(operations) - 1) + [k < successes], k < successes, k),
            **{"seed": first_seed + k, **changes},
        )
        for task, memory_type, operations in (("one", "temporal", "SU"), ("two_of_them", "spatial", "SUC"))
        for k in range(episodes)
    ]
    write_episodes(folder, records)
    return folder
