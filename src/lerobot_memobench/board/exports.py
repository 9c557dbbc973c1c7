"""A result in the formats of other boards: LeRobot, Hugging Face, vla-evaluation-harness."""

from __future__ import annotations

import itertools
import json
import math
import re
from collections.abc import Sequence
from typing import Any

from lerobot_memobench.board.check import SEEDS, departures, is_complete
from lerobot_memobench.board.submission import ABOUT, About
from lerobot_memobench.envs.episode_log import INPUTS, with_omitted
from lerobot_memobench.evaluation.headline import extent_phrase
from lerobot_memobench.evaluation.metrics import METRICS, Rate, Record, Row, by_task, percent, success_rate
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.io import checked
from lerobot_memobench.run.card import PACKAGES
from lerobot_memobench.tasks.catalogue import task_names
from lerobot_memobench.tasks.task import MEMORY_TYPES


def about_of(run: Run) -> About | None:
    """Return the statements of a submission, None for an evaluation without them."""
    block = run.card.get(ABOUT)
    return None if block is None else checked(block, About)


def model_of(run: Run) -> str:
    """Return the name of a policy: as submitted, else its checkpoint, else its type."""
    about, checkpoint = about_of(run), run.card.get("checkpoint") or {}
    return about.model if about else str(checkpoint.get("path") or run.card.get("policy", {}).get("type") or run.name)


# --- LeRobot: eval_info.json ---


def lerobot_json(run: Run) -> str:
    """Return ``eval_info.json`` as `lerobot-eval` writes it, with counts, intervals and provenance.

    `lerobot-eval-compare` reads ``per_task``. The reward of an episode is 1 for a success. ``provenance`` holds what
    LeRobot asks of a row of a leaderboard: revisions of policy and dataset, seed, episodes per task, versions.
    """
    groups: dict[str, list[Record]] = {}
    tasks = []
    for name, records in by_task(run.records).items():
        group = str(records[0]["memory_type"])
        groups.setdefault(group, []).extend(records)
        rewards = [float(bool(record["success"])) for record in records]
        metrics = {"sum_rewards": rewards, "max_rewards": rewards, "successes": [bool(reward) for reward in rewards]}
        tasks.append(
            {"task_group": group, "task_id": name, "metrics": metrics | {"video_paths": []}, **_counts(records)}
        )
    found = {
        "per_task": tasks,
        "per_group": {name: _aggregate(records) for name, records in groups.items()},
        "overall": _aggregate(run.records),
        "provenance": _provenance(run),
    }
    return json.dumps(found, indent=2) + "\n"


def _counts(records: Sequence[Record]) -> dict[str, Any]:
    count, done = len(records), sum(bool(record["success"]) for record in records)
    interval = [100 * end for end in success_rate(records).interval or ()]
    return {"n_episodes": count, "n_success": done, "pc_success": 100 * done / count, "pc_success_ci95": interval}


def _aggregate(records: Sequence[Record]) -> dict[str, Any]:
    counts = _counts(records)
    reward = counts["pc_success"] / 100
    times = [float(record.get("wall_s") or 0.0) for record in records]
    return {
        "avg_sum_reward": reward,
        "avg_max_reward": reward,
        **counts,
        "eval_s": math.fsum(times),
        "eval_ep_s": math.fsum(times) / len(times),
        "video_paths": [],
    }


def _provenance(run: Run) -> dict[str, Any]:
    card = run.card
    checkpoint, trained = card.get("checkpoint") or {}, card.get("trained_on") or {}
    versions = card["runs"][-1].get("versions", {}) if card.get("runs") else {}
    counts = {len(group) for group in by_task(run.records).values()}
    return {
        "policy_revision": checkpoint.get("revision") or card.get("policy", {}).get("sha256"),
        "dataset_revision": trained.get("revision") or trained.get("sha256"),
        "seed": card.get("policy", {}).get("seed"),
        "episodes_per_task": counts.pop() if len(counts) == 1 else None,
        "missing": run.missing,
        "sim_version": versions.get("mujoco"),
        "tool": {"name": PACKAGES[0], "version": versions.get(PACKAGES[0])},
    }


# --- Hugging Face: .eval_results/*.yaml ---


def huggingface_yaml(run: Run, dataset: str) -> str:
    """Return the content of ``.eval_results/memobench.yaml`` of a model repository.

    Args:
        dataset: repository of the benchmark's dataset on the Hub, as ``user/name``.
    """
    import yaml
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    about, suite = about_of(run), with_omitted(run.protocol)["suite"]
    source = about.links.get("code") if about else None
    entries = [
        EvalResultEntry(
            dataset_id=dataset,
            task_id=f"{suite}_{metric.lower()}",
            value=percent(rate.value),
            date=str(run.card["written"])[:10] if "written" in run.card else None,
            source_url=source,
            notes=f"{_conditions(run)}{_interval(rate)}",
        )
        for metric in METRICS
        if (rate := run.summary.average[metric]).value is not None
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(entries), sort_keys=False, allow_unicode=True)


def _conditions(run: Run) -> str:
    protocol = with_omitted(run.protocol)
    found = departures(protocol)
    return (
        f"{protocol['suite']} suite, referent {protocol.get('referent')}, inputs: {protocol.get(INPUTS)}, "
        f"{extent_phrase(run.records)}, seeds from {protocol.get('seed_base')}"
        f"{f'; not the settings of the board ({"; ".join(found)})' if found else ''}"
        f"{f'; {run.missing}' if run.missing else ''}"
    )


def _interval(rate: Rate) -> str:
    return "" if rate.interval is None else "; 95 % interval {} to {}".format(*map(percent, rate.interval))


# --- vla-evaluation-harness: leaderboard.json ---


HANDLE, NO_HANDLE = re.compile(r"@[\w-]+"), "human"
"""Accepted form of ``curated_by``, and its value without a GitHub account."""


def vla_eval_json(run: Run) -> str:
    """Return the entry of a result in the form of vla-evaluation-harness' ``leaderboard.json``.

    ``overall_score`` is set for the standard protocol only: all tasks of the suite, all episodes, seeds that count.
    Otherwise the average is ``reported_avg`` of ``task_scores``, as that board asks.
    """
    about, protocol, summary = about_of(run), with_omitted(run.protocol), run.summary
    model = model_of(run)
    whole = is_complete(protocol) and {(record["task"], record["episode"]) for record in run.records} == {
        *itertools.product(task_names(suite=protocol["suite"]), range(protocol["episodes"]))
    }
    day = about.date if about else str(run.card.get("written", ""))[:10]
    submitter = about.submitter if about else ""
    scores = {kind: _score(summary.memory_types[kind]) for kind in MEMORY_TYPES if kind in summary.memory_types}
    standard = whole and protocol.get("seed_base") in SEEDS and not departures(protocol)
    average = _score(summary.average)
    tasks = {name: _score(row) for name, row in summary.tasks.items()}
    entry = {
        "model": re.sub(r"\W+", "_", model.lower()).strip("_"),
        "display_name": model,
        "benchmark": f"memobench_{protocol['suite']}",
        "overall_score": average if standard else None,
        "suite_scores": scores,
        "task_scores": tasks if standard else {**tasks, "reported_avg": average},
        "reported_paper": about.links.get("paper") if about else None,
        "curated_by": submitter if HANDLE.fullmatch(submitter) else NO_HANDLE,
        "notes": _conditions(run),
        "date_added": day,
        "params": _parameters(about.parameters) if about and about.parameters else None,
        "weight_type": "finetuned",
    }
    return json.dumps({"last_updated": day, "results": [entry]}, indent=2, ensure_ascii=False) + "\n"


def _score(row: Row) -> float:
    return percent(row["SR"].value) or 0.0


def _parameters(count: int) -> str:
    """Return a number of parameters as 3.2B, 450M or 12K."""
    for unit, size in (("B", 10**9), ("M", 10**6), ("K", 10**3)):
        if count >= size:
            return f"{count / size:.3g}{unit}"
    return str(count)
