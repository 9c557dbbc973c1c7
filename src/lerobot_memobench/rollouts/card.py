"""The result card of an evaluation, ``evaluation.json`` (`evaluation_file.Card`): all that is needed to repeat it."""

from __future__ import annotations

import datetime as dt
import json
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from lerobot_memobench.commands.command_line import without
from lerobot_memobench.datasets.generate import task_hash
from lerobot_memobench.envs.evaluation_file import FORMAT, INPUTS, POLICY
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash, files_below
from lerobot_memobench.jobs.threads import cores, cpu_model
from lerobot_memobench.policies.checkpoint import (
    ADAPTER_FILE,
    ELSEWHERE,
    TRAIN_CONFIG,
    WEIGHTS_FILE,
    TrainConfig,
    checkpoint_files,
    encoded_config,
    identity_of,
    local_folder,
    portable_path,
    tree_hash,
)
from lerobot_memobench.rollouts.plan import EvaluationPlan
from lerobot_memobench.tasks.catalogue import load_task
from lerobot_memobench.untrusted import read_json

PACKAGES = ("lerobot_policy_memobench", "lerobot", "mujoco", "torch", "transformers", "numpy", "gymnasium")

# --- the card of a plan, before anything has been found ---


def card_of(plan: EvaluationPlan) -> dict[str, Any]:
    """Return the card of an evaluation that is about to begin. Hashes the checkpoint."""
    environment, shard = plan.environment, plan.options.shard
    protocol = {
        "tasks": sorted(task.name for task in plan.grid.tasks),
        "episodes": plan.grid.runs,
        **environment.settings.protocol_block,
        INPUTS: policy_inputs(plan.policy, environment.obs_type, environment.oracle_memory),
    }
    card = {
        "format": FORMAT,
        "written": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "protocol": protocol,
        POLICY: policy_facts(encoded_config(plan.policy), plan.seed),
        "checkpoint": None,
        "trained_on": None,
        "task_files": {task.name: task_hash(load_task(task)) for task in plan.grid.tasks},
        "settings": plan.settings.portable,
        "shard": None if shard is None else str(shard),
        "runs": [{**run_facts(plan.command, plan.batch), "times": 1}],
    }
    return with_checkpoint(card, plan)


def with_checkpoint(card: dict[str, Any], plan: EvaluationPlan) -> dict[str, Any]:
    """Return a card with the facts of the checkpoint; those of a repository are known once LeRobot has fetched it."""
    path, policy = plan.policy_path, card[POLICY]
    folder = None if path is None else local_folder(path)
    if "identity" in policy or (path is not None and folder is None):
        return card
    if folder is None:
        return {**card, POLICY: {**policy, "identity": identity_of(plan.policy, None, None)}}
    files = checkpoint_files(folder)
    if not any(name in files for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        return card
    weights = tree_hash(files)
    return {
        **card,
        POLICY: {**policy, "identity": identity_of(plan.policy, path, weights), "sha256": weights},
        "checkpoint": {
            "path": portable_path(str(path)),
            "revision": folder.name if folder.parent.name == "snapshots" else None,  # a copy in the hub's cache
            "files": files,
        },
        "trained_on": training_facts(folder),
    }


# --- facts of the policy: settings, seed, hash of its detector, its dataset ---


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return the facts that identify a policy apart from its weights: its configuration, seed and detector."""
    recorded = without(settings, *ELSEWHERE, "type")
    facts = {"type": settings.get("type"), "seed": seed, "settings": recorded}
    if (detector := detector_hash(recorded)) is not None:  # a checkpoint does not contain the detector
        facts["detector_sha256"] = detector
    return facts


def detector_hash(settings: Mapping[str, Any]) -> str | None:
    """Return the hash of the detector that a policy reads objects from, None without one; raise if it is missing."""
    if settings.get("detector") is None:
        return None
    from lerobot_memobench.perception.detector import detector_file

    return file_hash(detector_file(settings["detector"]))


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return the dataset that a checkpoint was trained on, None where the checkpoint does not name it.

    ``sha256``, of a dataset on this machine, is that of its meta files and its manifest, which hold a digest of every
    episode that `memobench generate` made.
    """
    try:
        config = read_json(folder / TRAIN_CONFIG, TrainConfig, "it is ignored")
    except (FileNotFoundError, MemobenchError):
        return None
    dataset = config["dataset"]
    facts = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    facts["steps"] = config.get("steps")
    root = Path(str(facts["root"] or ""))
    if facts["root"] and os.path.isdir(root / "meta"):  # pathlib raises at names that are too long
        files = sorted(path for path in [*files_below(root / "meta"), root / "manifest.json"] if path.is_file())
        facts["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return facts


# --- facts of one start on this machine: versions, commit, processor ---


def run_facts(command: Sequence[str], batch: int) -> dict[str, Any]:
    """Return the facts of one start of an evaluation on this machine."""
    import torch

    gpu = str(torch.cuda.get_device_name(0)) if torch.cuda.is_available() else None
    return {
        "command": list(command),
        "batch_size": batch,
        "versions": versions(),
        "git_commit": git_commit(),
        "machine": {"cpu": cpu_model(), "cores": cores(), "gpu": gpu, "system": platform.platform()},
    }


def versions() -> dict[str, str]:
    """Return the versions on which an evaluation's numbers may depend."""
    installed = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            installed[name] = "not installed"
    return installed


def git_commit() -> str | None:
    """Return the commit of the checkout, with ``+changes`` where files of ``src`` differ; None outside a checkout."""
    package = Path(__file__).resolve().parents[1]
    if not (package.parents[1] / ".git").exists() or not (commit := git(package, "rev-parse", "HEAD")):
        return None
    return commit + ("+changes" if git(package, "status", "--porcelain", "--", str(package.parent)) else "")


def git(folder: Path, *words: str) -> str | None:
    """Return the output of ``git`` in a folder, None where it fails."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), *words], capture_output=True, text=True, timeout=20, check=False
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return done.stdout.strip() if done.returncode == 0 else None


# --- cards joined ---


def extended(card: Mapping[str, Any], other: Mapping[str, Any], folder: Path, *, again: bool = True) -> dict[str, Any]:
    """Return a card for two runs of one evaluation, with the extent, runs and task hashes of both.

    Other task files than those of ``folder``, of one of the runs, are refused. ``again``: whether an equal run is
    another start, or the same start read twice.
    """
    for name, value in card["task_files"].items():
        if other["task_files"].get(name, value) != value:
            raise MemobenchError(f"the episodes of {name} in {folder} were run with other task files")
    a, b = card["protocol"], other["protocol"]
    extent = {"tasks": sorted({*a["tasks"], *b["tasks"]}), "episodes": max(a["episodes"], b["episodes"])}
    settings = card["settings"]
    if extent["tasks"] != sorted(a["tasks"]):
        settings = {**settings, "env": {**settings.get("env", {}), "tasks": ",".join(extent["tasks"])}}
    return {
        **other,
        **card,
        "protocol": {**b, **a, **extent},
        **{name: card[name] or other[name] for name in (POLICY, "checkpoint", "trained_on")},
        "task_files": {**card["task_files"], **other["task_files"]},
        "settings": settings,
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
    }


def joined_runs(runs: Iterable[Mapping[str, Any]], again: bool = True) -> list[dict[str, Any]]:
    """Return runs without repetitions; ``times`` counts the starts of each."""
    distinct: dict[str, dict[str, Any]] = {}
    for run in runs:
        same = distinct.setdefault(json.dumps(without(run, "times"), sort_keys=True), {**run, "times": 0})
        times = run.get("times", 1)
        same["times"] = same["times"] + times if again else max(same["times"], times)
    return [*distinct.values()]
