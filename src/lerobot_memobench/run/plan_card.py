"""The card of a plan: what is known of an evaluation before it has found anything."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import SAW
from lerobot_memobench.envs.observations import what_is_seen
from lerobot_memobench.policies.checkpoint import ADAPTER_FILE, WEIGHTS_FILE, local_folder, portable_path
from lerobot_memobench.run.card import new_card
from lerobot_memobench.run.machine import gl_facts, run_facts
from lerobot_memobench.run.plan import EvaluationPlan
from lerobot_memobench.run.policy_identity import (
    checkpoint_files,
    encoded,
    policy_facts,
    training_facts,
    tree_hash,
)


def card_of(plan: EvaluationPlan, *, here: bool = True) -> dict[str, Any]:
    """Return the card of an evaluation that is about to begin. Hashes the checkpoint, opens a GL context if need be.

    Args:
        here: whether it is run on this machine, whose GL then counts.
    """
    shard = plan.orders.shard
    card = new_card(
        protocol=_protocol(plan),
        policy={} if plan.policy is None else policy_facts(encoded(plan.policy), plan.seed),
        checkpoint=None,
        trained_on=None,
        task_files=_task_files(plan),
        flags=_flags(plan),
        runs=[run_facts(plan.command, plan.batch, gl_facts() if plan.draws and here else {})],
        shard=None if shard is None else str(shard),
    )
    return with_checkpoint(card, plan.policy_path)


def _flags(plan: EvaluationPlan) -> list[str]:
    """Return the plan's flags as another machine may use them: a policy of this package goes by its name."""
    key = "--policy.path="
    return [
        key + portable_path(flag.removeprefix(key)) if flag.startswith(key) else flag for flag in plan.portable_flags
    ]


def _protocol(plan: EvaluationPlan) -> dict[str, Any]:
    if plan.grid is None or plan.environment is None:
        return {}
    names = sorted(place.task.name for place in plan.grid.places)
    environment = plan.environment
    seen = (
        {} if plan.policy is None else {SAW: what_is_seen(plan.policy, environment.obs_type, environment.oracle_memory)}
    )
    return {"tasks": names, "episodes": plan.grid.runs, **environment.protocol, **seen}


def _task_files(plan: EvaluationPlan) -> dict[str, str]:
    from lerobot_memobench.datasets.generation import task_hash

    return {} if plan.grid is None else {place.task.name: task_hash(place.task) for place in plan.grid.places}


def with_checkpoint(card: dict[str, Any], path: str | None) -> dict[str, Any]:
    """Return a card with what is known of the checkpoint; a repository's is known once LeRobot has fetched it."""
    folder = None if path is None else local_folder(path)
    if folder is None or "sha256" in card["policy"]:
        return card
    files = checkpoint_files(folder)
    if not any(name in files for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        return card
    return {
        **card,
        "policy": {**card["policy"], "sha256": tree_hash(files)},
        "checkpoint": {"path": portable_path(str(path)), "revision": _revision(folder), "files": files},
        "trained_on": training_facts(folder),
    }


def _revision(folder: Path) -> str | None:
    """Return the commit of a repository's copy in the hub's cache, None for any other folder."""
    return folder.name if folder.parent.name == "snapshots" else None
