"""The result card of an evaluation, ``evaluation.json``: everything needed to understand, repeat and check it.

It is written when an evaluation starts, and again with the outcomes when it ends. `evaluation_file.WholeCard` lists its
parts.
"""

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

from lerobot_memobench.envs.episode_log import INPUTS, key_of
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, FORMAT
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import outcome
from lerobot_memobench.io import file_hash, files_below, read_json, write_file
from lerobot_memobench.jobs.threads import cores, cpu_model
from lerobot_memobench.policies.checkpoint import (
    ADAPTER_FILE,
    TRAIN_CONFIG,
    WEIGHTS_FILE,
    TrainConfig,
    local_folder,
    portable_path,
)
from lerobot_memobench.policies.lerobot_config import ELSEWHERE, checkpoint_files, encoded, tree_hash
from lerobot_memobench.run.plan import EvaluationPlan

PACKAGES = ("lerobot_policy_memobench", "lerobot", "mujoco", "torch", "transformers", "numpy", "gymnasium")

# --- the card of a plan, before anything has been found ---


def card_of(plan: EvaluationPlan) -> dict[str, Any]:
    """Return the card of an evaluation that is about to begin. Hashes the checkpoint."""
    from lerobot_memobench.datasets.generate import task_hash
    from lerobot_memobench.tasks.catalogue import load_task

    environment, shard = plan.environment, plan.options.shard
    protocol = {
        "tasks": sorted(task.name for task in plan.grid.tasks),
        "episodes": plan.grid.runs,
        **environment.settings.protocol_block,
        INPUTS: policy_inputs(plan.policy, environment.obs_type, environment.oracle_memory),
    }
    card = new_card(
        protocol=protocol,
        policy=policy_facts(encoded(plan.policy), plan.seed),
        checkpoint=None,
        trained_on=None,
        task_files={task.name: task_hash(load_task(task.folder)) for task in plan.grid.tasks},
        settings=plan.settings.portable,
        runs=[run_facts(plan.command, plan.batch)],
        shard=None if shard is None else str(shard),
    )
    return with_checkpoint(card, plan.policy_path)


def new_card(
    *,
    protocol: Mapping[str, Any],
    policy: Mapping[str, Any],
    checkpoint: Mapping[str, Any] | None,
    trained_on: Mapping[str, Any] | None,
    task_files: Mapping[str, str],
    settings: Mapping[str, Any],
    runs: Sequence[Mapping[str, Any]],
    shard: str | None = None,
) -> dict[str, Any]:
    """Return a card without outcomes."""
    return {
        "format": FORMAT,
        "written": dt.datetime.now(dt.UTC).isoformat(timespec="seconds"),
        "protocol": dict(protocol),
        "policy": dict(policy),
        "checkpoint": checkpoint,
        "trained_on": trained_on,
        "task_files": dict(task_files),
        "settings": dict(settings),
        "shard": shard,
        "runs": joined_runs(runs),
        "episodes": [],
    }


def with_checkpoint(card: dict[str, Any], path: str | None) -> dict[str, Any]:
    """Return a card with the facts of the checkpoint; those of a repository are known once LeRobot has fetched it."""
    folder = None if path is None else local_folder(path)
    if folder is None or "sha256" in card["policy"]:
        return card
    files = checkpoint_files(folder)
    if not any(name in files for name in (WEIGHTS_FILE, ADAPTER_FILE)):
        return card
    return {
        **card,
        "policy": {**card["policy"], "sha256": tree_hash(files)},
        "checkpoint": {
            "path": portable_path(str(path)),
            "revision": folder.name if folder.parent.name == "snapshots" else None,  # a copy in the hub's cache
            "files": files,
        },
        "trained_on": training_facts(folder),
    }


# --- facts of the policy: settings, seed, hash of its detector, its dataset ---


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return the facts that identify a policy apart from its weights.

    They are its configuration as LeRobot encodes it, the seed of the run and, as a detector is not part of a
    checkpoint, the detector's hash.

    Raises:
        MemobenchError: the detector does not exist.
    """
    kept = {key: value for key, value in settings.items() if key not in ELSEWHERE and key != "type"}
    detector = detector_hash(kept)
    return {
        "type": settings.get("type"),
        "seed": seed,
        "settings": kept,
        **({} if detector is None else {"detector_sha256": detector}),
    }


def detector_hash(settings: Mapping[str, Any]) -> str | None:
    """Return the hash of the detector that a policy reads objects from, None without one.

    Raises:
        MemobenchError: the detector does not exist.
    """
    if settings.get("detector") is None:
        return None
    from lerobot_memobench.perception.weights import detector_file

    return file_hash(detector_file(settings["detector"]))


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return the dataset that a checkpoint was trained on, None where the checkpoint does not name it.

    Where the dataset is on this machine, ``sha256`` is that of its meta files and its manifest, which in turn hold a
    digest of every episode that `memobench generate` made.
    """
    try:
        config = read_json(folder / TRAIN_CONFIG, TrainConfig, "it is ignored")
    except (FileNotFoundError, MemobenchError):
        return None
    dataset = config["dataset"]
    found = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    found["steps"] = config.get("steps")
    root = Path(str(found["root"] or ""))
    if found["root"] and os.path.isdir(root / "meta"):  # pathlib raises at names that are too long
        files = sorted(path for path in [*files_below(root / "meta"), root / "manifest.json"] if path.is_file())
        found["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return found


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
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "not installed"
    return found


def git_commit() -> str | None:
    """Return the commit of the checkout, with ``+changes`` where files of ``src`` differ; None outside a checkout."""
    package = Path(__file__).resolve().parents[1]
    if not (package.parents[1] / ".git").exists():
        return None
    commit = git(package, "rev-parse", "HEAD")
    if not commit:
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


def drawn_with(run: Mapping[str, Any]) -> dict[str, str]:
    """Return the versions of a card's run and the renderer of its pictures: the CPU, or OpenGL on an older card."""
    return {**run["versions"], "GL backend": "none, drawn on the CPU", **run.get("gl", {})}


# --- cards joined and written ---


def extended(card: Mapping[str, Any], other: Mapping[str, Any], *, again: bool = True) -> dict[str, Any]:
    """Return a card for two runs of one evaluation, with the extent, episodes, runs and task hashes of both.

    Args:
        again: whether an equal run is another start, or the same start read twice.
    """
    a, b = card["protocol"], other["protocol"]
    extent = {"tasks": sorted({*a["tasks"], *b["tasks"]}), "episodes": max(a["episodes"], b["episodes"])}
    found = {**other, **card}  # a card of an earlier version has flags and no settings
    found.pop("flags", None)
    settings = {**(found.get("settings") or {}), "episodes": extent["episodes"]}
    if extent["tasks"] != sorted((a if "settings" in card else b)["tasks"]):
        settings["env"] = {**settings.get("env", {}), "tasks": ",".join(extent["tasks"])}
    return {
        **found,
        "format": FORMAT,
        "protocol": {**b, **a, **extent},
        **{name: card[name] or other[name] for name in ("policy", "checkpoint", "trained_on")},
        "task_files": {**card["task_files"], **other["task_files"]},
        "settings": settings,
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
        "episodes": _joined_episodes(card["episodes"], other["episodes"]),
    }


def joined_runs(runs: Iterable[Mapping[str, Any]], again: bool = True) -> list[dict[str, Any]]:
    """Return runs without repetitions; ``times`` counts the starts of each."""
    found: list[dict[str, Any]] = []
    for run in runs:
        same = next((r for r in found if all(r.get(key) == run.get(key) for key in {*r, *run} - {"times"})), None)
        times = run.get("times", 1)
        if same is None:
            found.append({**run, "times": times})
        else:
            same["times"] = same["times"] + times if again else max(same["times"], times)
    return found


def with_episodes(card: Mapping[str, Any], records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a card with the outcomes of a log; an episode that is on the card already keeps its outcome."""
    return {**card, "episodes": _joined_episodes(card["episodes"], map(outcome, records))}


def _joined_episodes(mine: Iterable[Mapping[str, Any]], others: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the episodes of both, sorted, each once, with the outcome of ``mine``."""
    found = {key_of(episode): dict(episode) for episode in others}
    for episode in mine:
        found[key_of(episode)] = {**found.get(key_of(episode), {}), **episode}
    return [found[key] for key in sorted(found)]


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write the file of an evaluation, whole or not at all, with one episode a line: there may be 1,500."""
    episodes = ",\n".join(f"  {json.dumps(episode)}" for episode in card["episodes"])
    head = {key: value for key, value in card.items() if key != "episodes"}
    text = json.dumps(head, indent=1).removesuffix("\n}")
    write_file(folder / EVALUATION_FILE, f'{text},\n "episodes": [\n{episodes}\n ]\n}}\n', durable=True)


# --- variants drawn by an earlier version ---


def first_variant_mismatch(records: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the first episode of a log or card whose variant this version would not draw by its seed, None for none.

    Earlier versions drew each seed's variant by itself; this version draws in balance. Users' own tasks are not
    checked.
    """
    from lerobot_memobench.envs.episode import referent_of
    from lerobot_memobench.tasks.catalogue import get_task, suite_of
    from lerobot_memobench.tasks.evidence import scene_and_variant
    from lerobot_memobench.tasks.task import STANDARD

    for record in records:
        task, variant, seed = record["task"], record.get("variant"), record.get("seed")
        drawn = record.get("referent", "fixed") != "fixed" and suite_of(task) is not None
        if not drawn or variant is None or seed is None or seed < 0:
            continue
        found = get_task(task).at(record.get("difficulty", STANDARD))
        if "choice" in record:  # each scene was run with each variant
            here = scene_and_variant(found, record["episode"])[1]
        else:
            here = referent_of(found, seed, record.get("salt")).variant_index
        if here != variant:
            return f"{task}, episode {record['episode']}: variant {variant} there, {here} by its seed here"
    return None
