"""The result card of an evaluation, ``evaluation.json``: everything needed to understand, repeat and check it.

It is written when an evaluation starts, and again with the outcomes when it ends. `evaluation_file.Card` lists its
parts.
"""

from __future__ import annotations

import datetime as dt
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from lerobot_memobench.envs.episode_log import INPUTS, key_of
from lerobot_memobench.envs.evaluation_file import EVALUATION_FILE, FORMAT
from lerobot_memobench.envs.observations import policy_inputs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement import outcome
from lerobot_memobench.io import Count, file_hash, read_json, write_file
from lerobot_memobench.policies.checkpoint import ADAPTER_FILE, WEIGHTS_FILE, local_folder, portable_path
from lerobot_memobench.policies.lerobot_config import ELSEWHERE, checkpoint_files, encoded, tree_hash
from lerobot_memobench.run.machine import run_facts
from lerobot_memobench.run.plan import EvaluationPlan

# --- the card of a plan, before anything has been found ---


def card_of(plan: EvaluationPlan) -> dict[str, Any]:
    """Return the card of an evaluation that is about to begin. Hashes the checkpoint."""
    shard = plan.options.shard
    card = new_card(
        protocol=_protocol_of(plan),
        policy=policy_facts(encoded(plan.policy), plan.seed),
        checkpoint=None,
        trained_on=None,
        task_files=_task_files(plan),
        settings=plan.settings.portable,
        runs=[run_facts(plan.command, plan.batch)],
        shard=None if shard is None else str(shard),
    )
    return with_checkpoint(card, plan.policy_path)


def _protocol_of(plan: EvaluationPlan) -> dict[str, Any]:
    names = sorted(task.name for task in plan.grid.tasks)
    environment = plan.environment
    inputs = policy_inputs(plan.policy, environment.obs_type, environment.oracle_memory)
    return {"tasks": names, "episodes": plan.grid.runs, **environment.settings.protocol_block, INPUTS: inputs}


def _task_files(plan: EvaluationPlan) -> dict[str, str]:
    from lerobot_memobench.datasets.generation import task_hash
    from lerobot_memobench.tasks.catalogue import load_task

    return {task.name: task_hash(load_task(task.folder)) for task in plan.grid.tasks}


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
        "checkpoint": {
            "path": portable_path(str(path)),
            "revision": folder.name if folder.parent.name == "snapshots" else None,  # a copy in the hub's cache
            "files": files,
        },
        "trained_on": training_facts(folder),
    }


# --- what identifies a policy beyond its name: settings, seed, hash of its checkpoint, what it was trained on ---


class TrainedOn(TypedDict, total=False):
    """LeRobot's settings of the dataset of a training run."""

    repo_id: str | None
    revision: str | None
    root: str | None
    episodes: list[int] | None


class TrainConfig(TypedDict):
    """What is used of a checkpoint's ``train_config.json``."""

    dataset: TrainedOn
    steps: NotRequired[Count | None]


def policy_facts(settings: Mapping[str, Any], seed: int | None) -> dict[str, Any]:
    """Return what identifies a policy apart from its weights: its configuration as LeRobot encodes it, the run's seed.

    Of a detector, which is no part of its checkpoint, also the hash.

    Raises:
        MemobenchError: there is no such detector.
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
    """Return the hash of the detector that a policy reads objects from, None where it has none.

    Raises:
        MemobenchError: there is no such detector.
    """
    if settings.get("detector") is None:
        return None
    from lerobot_memobench.perception.weights import detector_file

    return file_hash(detector_file(settings["detector"]))


def training_facts(folder: Path) -> dict[str, Any] | None:
    """Return what a checkpoint says about the dataset it was trained on, None where it says nothing.

    Where the dataset is on this machine, ``sha256`` is that of its meta files and its manifest, which in turn hold a
    digest of every episode that `memobench generate` made.
    """
    try:
        told = read_json(folder / "train_config.json", TrainConfig, "it is ignored")
    except (FileNotFoundError, MemobenchError):
        return None
    dataset = told["dataset"]
    found = {key: dataset.get(key) for key in ("repo_id", "revision", "root", "episodes")}
    found["steps"] = told.get("steps")
    root = Path(str(found["root"] or ""))
    if found["root"] and os.path.isdir(root / "meta"):  # pathlib's raises at names that are too long
        files = sorted(path for path in [*(root / "meta").rglob("*"), root / "manifest.json"] if path.is_file())
        found["sha256"] = tree_hash({str(path.relative_to(root)): file_hash(path) for path in files})
    return found


# --- cards put together and written ---


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
    """Return the card of an evaluation that has found nothing yet."""
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


def extended(card: Mapping[str, Any], other: Mapping[str, Any], *, again: bool = True) -> dict[str, Any]:
    """Return a card for both of two runs of one evaluation: extent, episodes, runs and tasks' hashes of both.

    Args:
        again: whether an equal run is one more start, or the same start read twice.
    """
    a, b = card["protocol"], other["protocol"]
    extent = {"tasks": sorted({*a["tasks"], *b["tasks"]}), "episodes": max(a["episodes"], b["episodes"])}
    found = {**other, **card}  # a card of an earlier version has flags and no settings
    found.pop("flags", None)
    return {
        **found,
        "format": FORMAT,
        "protocol": {**b, **a, **extent},
        "policy": card["policy"] or other["policy"],
        "checkpoint": card["checkpoint"] or other["checkpoint"],
        "trained_on": card["trained_on"] or other["trained_on"],
        "task_files": {**card["task_files"], **other["task_files"]},
        "settings": _widened(found.get("settings") or {}, a if "settings" in card else b, extent),
        "shard": card["shard"] if card["shard"] == other["shard"] else None,
        "runs": joined_runs([*card["runs"], *other["runs"]], again),
        "episodes": _joined_episodes(card["episodes"], other["episodes"]),
    }


def _widened(settings: Mapping[str, Any], protocol: Mapping[str, Any], extent: Mapping[str, Any]) -> dict[str, Any]:
    """Return a card's settings, changed to a wider extent."""
    found = {**settings, "episodes": extent["episodes"]}
    if extent["tasks"] != sorted(protocol["tasks"]):
        found["env"] = {**settings.get("env", {}), "tasks": ",".join(extent["tasks"])}
    return found


def joined_runs(runs: Iterable[Mapping[str, Any]], again: bool = True) -> list[dict[str, Any]]:
    """Return runs without repetitions; ``times`` says how often one was started."""
    found: list[dict[str, Any]] = []
    for run in runs:
        same = next((r for r in found if all(r.get(key) == run.get(key) for key in {*r, *run} - {"times"})), None)
        if same is None:
            found.append({**run, "times": run.get("times", 1)})
        else:
            times = run.get("times", 1)
            same["times"] = same["times"] + times if again else max(same["times"], times)
    return found


def with_episodes(card: Mapping[str, Any], records: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a card that holds what was found; an episode that is on it stays as it is, whatever a log says later."""
    return {**card, "episodes": _joined_episodes(card["episodes"], map(outcome, records))}


def _joined_episodes(mine: Iterable[Mapping[str, Any]], others: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return the episodes of both, sorted, each once, with the outcome that ``mine`` names."""
    found = {key_of(episode): dict(episode) for episode in others}
    for episode in mine:
        found[key_of(episode)] = {**found.get(key_of(episode), {}), **episode}
    return [found[key] for key in sorted(found)]


def write_card(folder: Path, card: Mapping[str, Any]) -> None:
    """Write the file of an evaluation, whole or not at all."""
    write_file(folder / EVALUATION_FILE, _json(card), durable=True)


def remove_card(folder: Path) -> None:
    """Remove the file of an evaluation, if there is one."""
    (folder / EVALUATION_FILE).unlink(missing_ok=True)


def _json(card: Mapping[str, Any]) -> str:
    """Return the card as JSON with one episode a line: there may be 1,500."""
    episodes = ",\n".join(f"  {json.dumps(episode)}" for episode in card["episodes"])
    text = json.dumps({**card, "episodes": []}, indent=1)
    return (
        text.replace('"episodes": []\n}', f'"episodes": [\n{episodes}\n ]\n}}' if episodes else '"episodes": []\n}')
        + "\n"
    )


# --- whether an episode was drawn as it is drawn here ---


def first_variant_mismatch(records: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the first episode of a log or card whose variant is not the one that its seed draws here, None for none.

    Before variants were drawn in balance, each seed drew its own by itself. Tasks of one's own are not looked at.
    """
    from lerobot_memobench.envs.episode import referent_of
    from lerobot_memobench.tasks.catalogue import get_task, suite_of
    from lerobot_memobench.tasks.evidence import scene_and_variant

    for record in records:
        task, told, seed = record["task"], record.get("variant"), record.get("seed")
        drawn = record.get("referent", "fixed") != "fixed" and suite_of(task) is not None
        if not drawn or told is None or seed is None or seed < 0:
            continue
        if "choice" in record:  # each scene was run with each variant
            here = scene_and_variant(get_task(task), record["episode"])[1]
        else:
            here = referent_of(get_task(task), seed).variant_index
        if here != told:
            return f"{task}, episode {record['episode']}: variant {told} there, {here} by its seed here"
    return None
