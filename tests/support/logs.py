"""Evaluations made by hand, for tests of what is made of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import EpisodeRecord, write_episodes
from lerobot_memobench.envs.evaluation_file import FORMAT, has_evaluation, read_evaluation, write_evaluation
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.rollouts.card import run_facts

Mark = tuple[str, int | None, int | None]
"""A checkpoint of a rollout: operation, first step, ordered step."""
SETTINGS = EnvSettings(prompt_in="steps").protocol_block


def facts(
    protocol: Mapping[str, Any] = SETTINGS, policy: Mapping[str, Any] | None = None, **others: Any
) -> dict[str, Any]:
    """The content of an evaluation's file."""
    return {"format": FORMAT, "protocol": dict(protocol), "policy": dict(policy or {}), **others}


def card(protocol: Mapping[str, Any], policy: Mapping[str, Any] | None = None, **others: Any) -> dict[str, Any]:
    """The content of an evaluation's file as `lerobot eval` writes it."""
    whole = {
        **{"written": "2026-11-28T10:00:00+00:00", "checkpoint": None, "trained_on": None, "task_files": {}},
        **{"settings": {}, "shard": None, "runs": [run_facts(["lerobot", "eval"], 1)]},
    }
    return facts(protocol, policy, **whole | others)


def protocol_of(folder: Path) -> dict[str, Any]:
    """The protocol of an evaluation's file."""
    found: dict[str, Any] = read_evaluation(folder)["protocol"]
    return found


def write_log(folder: Path, records: Iterable[Mapping[str, Any]], **policy: Any) -> Path:
    """Write records; settings that they contain go into the evaluation's file, unless there is one."""
    records = list(records)
    shared: dict[str, Any] = {}
    for each in records:
        for name in {*each} - {*EpisodeRecord.__annotations__}:
            assert shared.setdefault(name, each[name]) == each[name], f"{name} differs between the records"
    identity = {"identity": name} if (name := shared.pop("policy", None)) else {}
    shared |= {"evidence": True} if any("choice" in each for each in records) else {}
    if not has_evaluation(folder):
        write_evaluation(folder, facts({**SETTINGS, **shared}, identity | policy))
    write_episodes(folder, records)
    return folder


def record(
    task: str = "a_task", episode: int = 0, marks: Iterable[Mark] = (("S", 3, 3),), **changes: Any
) -> dict[str, Any]:
    """A successful rollout; ``marks`` are its checkpoints."""
    return {
        "task": task,
        "memory_type": "temporal",
        "episode": episode,
        "seed": 7 + episode,
        "replan_steps": 5,
        "success": True,
        "checkpoints": [
            {"operation": operation, "first_step": first, "ordered_step": ordered}
            for operation, first, ordered in marks
        ],
        "failure": None,
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


def evaluation(
    folder: Path,
    successes: int = 2,
    episodes: int = 4,
    first_seed: int = 7,
    policy: Mapping[str, Any] | None = None,
    **changes: Any,
) -> Path:
    """A log of two tasks: the first ``successes`` episodes of each succeed, the others miss their last checkpoint.

    Changes are of the records; those of settings go into the evaluation's file.
    """
    records = [
        rollout(
            *(task, memory_type, operations, [True] * (len(operations) - 1) + [k < successes], k < successes, k),
            **{"seed": first_seed + k, "seed_base": first_seed, **changes},
        )
        for task, memory_type, operations in (("one", "temporal", "SU"), ("two_of_them", "spatial", "SUC"))
        for k in range(episodes)
    ]
    return write_log(folder, records, **policy or {})
