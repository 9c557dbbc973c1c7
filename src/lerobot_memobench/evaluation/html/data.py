"""Data of the page from episode logs: rates, texts and timelines, as plain JSON values.

All figures are computed by ``evaluation.metrics``; the page only draws and filters.
"""

from __future__ import annotations

import shlex
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench import __version__
from lerobot_memobench.envs.video import OPERATION_COLOURS
from lerobot_memobench.evaluation.comparison import comparison_phrase, controls_among
from lerobot_memobench.evaluation.evidence import evidence_phrase
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.metrics import (
    SUITE,
    Rate,
    Record,
    Row,
    Summary,
    by_task,
    failure_of,
    operations,
    percent,
)
from lerobot_memobench.evaluation.records import Run, unlike
from lerobot_memobench.evaluation.report import evaluation_report, outcomes
from lerobot_memobench.evaluation.tables import OPERATION_NAMES, csv_tables
from lerobot_memobench.io import count_of
from lerobot_memobench.policies.memory_reads import Chunk
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.tasks.catalogue import GROUPS, find_tasks, get_task, load_task, suite_of
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.libero_suites import libero_id
from lerobot_memobench.tasks.task import LEVELS, Task


def task_source(names: Iterable[str], task_dir: str | Path | None = None) -> dict[str, Task]:
    """Return the tasks whose texts are known: the named ones of the catalogue, and those of a folder of tasks."""
    own = {} if task_dir is None else {folder.name: load_task(folder) for folder in find_tasks(task_dir)}
    return {name: get_task(name) for name in names if suite_of(name) is not None} | own


def page_data(
    runs: Sequence[Run],
    videos: Sequence[Mapping[int, str]],
    known: Mapping[str, Task],
    reads: Sequence[Mapping[int, Sequence[Chunk]]] | None = None,
) -> dict[str, Any]:
    """Return all data of the page.

    Args:
        videos: per run, position of a rollout in its records -> address of its video, relative to the page.
        reads: per run, position of a rollout -> memory reads of its chunks; None: not recorded.
        known: task name -> task, for language and checkpoint texts.
    """
    controls: dict[str, list[str]] = {run.name: [] for run in runs}
    for each in controls_among(runs):
        controls[each.b].append(comparison_phrase(each))
    return {
        "version": __version__,
        "notices": unlike(runs),
        "fps": CONTROL_HZ,
        "levels": list(LEVELS),
        "memory_types": list(GROUPS),
        "suite": runs[0].summary.grouping == SUITE,
        "metrics": list(runs[0].summary.average),
        "operations": {
            key: {"name": OPERATION_NAMES[key], "colour": "#" + bytes(colour).hex()}
            for key, colour in OPERATION_COLOURS.items()
        },
        "failures": list(dict.fromkeys(name for run in runs for name in run.summary.failures)),
        "tasks": tasks_data([record for run in runs for record in run.records], known),
        "runs": [
            evaluation_on_page(run, addresses, of_run, controls[run.name])
            for run, addresses, of_run in zip(runs, videos, reads or [{}] * len(runs), strict=True)
        ],
    }


# --- tasks ---


def tasks_data(records: Sequence[Record], known: Mapping[str, Task]) -> dict[str, Any]:
    """Return per task of the rollouts, by memory type and name, its language, and the texts of each variant."""
    last = {record["task"]: record for record in records}
    result: dict[str, Any] = {}
    for name, (record,) in by_task(last.values()).items():
        task = known.get(name)
        variants = sorted({_variant(each) for each in records if each["task"] == name})
        if task is None or task.operations != operations(record):
            variants = []
        result[name] = {
            "memory_type": record["memory_type"],
            "id": libero_id(name),
            "language": task.title if task else name.replace("_", " "),
            "variants": {str(k): variant_data(task.variant(k)) for k in variants if task and k < task.num_variants},
        }
    return result


def variant_data(task: Task) -> dict[str, Any]:
    """Return goal and checkpoints of one variant; texts are coarse, intermediate, fine."""
    checkpoints = [{"goal": format_formula(each.goal), "texts": list(each.language)} for each in task.checkpoints]
    return {"goal": format_formula(task.goal), "checkpoints": checkpoints}


def _variant(record: Record) -> int:
    return int(record.get("variant") or 0)


# --- runs ---


def evaluation_on_page(
    run: Run, videos: Mapping[int, str], reads: Mapping[int, Sequence[Chunk]], controls: Sequence[str]
) -> dict[str, Any]:
    """Return one evaluation: protocol, rates, failures and rollouts."""
    summary = run.summary
    starts = [start for each in run.evaluations for start in each.card.get("runs", [])]
    return {
        "name": run.name,
        "headline": headline([run]),
        "facts": [*facts(run), *controls],
        "commands": [shlex.join(start["command"]) for start in starts if start.get("command")],
        "notes": list(run.notes),
        "csv": csv_tables(evaluation_report([run])),
        "average": row_data(summary.average) if summary.means else None,
        "memory_types": {name: row_data(row) for name, row in summary.memory_types.items()},
        "tasks": {name: task_data(name, summary) for name in summary.tasks},
        "episodes": [episode_data(record, videos.get(k), reads.get(k, ())) for k, record in enumerate(run.records)],
    }


def facts(run: Run) -> list[str]:
    """Return the line below the first one: rollouts, their horizon, and how often choices follow the evidence."""
    horizons = dict.fromkeys(each.protocol.get("horizon") for each in run.evaluations)
    evidence = [] if run.evidence is None else evidence_phrase(run.evidence)
    return [count_of(len(run.records), "rollout"), *(f"horizon {each}" for each in horizons if each), *evidence]


def task_data(name: str, summary: Summary) -> dict[str, Any]:
    """Return the rates of one task and, per checkpoint, how many rollouts got that far."""
    return {
        "rates": row_data(summary.tasks[name]),
        "operations": summary.operations_of[name],
        "prefix": [rate_data(rate) for rate in summary.prefix[name]],
        "ordered_prefix": [rate_data(rate) for rate in summary.ordered_prefix[name]],
        "outcomes": outcomes(summary, [name]),
    }


def row_data(row: Row) -> dict[str, Any]:
    """Return metric -> rate as `rate_data` writes it."""
    return {metric: rate_data(rate) for metric, rate in row.items()}


def rate_data(rate: Rate) -> list[float | int | None] | None:
    """Return [per cent, lower, upper bound of Wilson's 95 % interval, n]; None where not applicable."""
    if rate.interval is None:
        return None
    low, high = rate.interval
    return [percent(rate.value), percent(low), percent(high), rate.n]


def episode_data(record: Record, video: str | None, reads: Sequence[Chunk] = ()) -> dict[str, Any]:
    """Return one rollout.

    Checkpoints are [operation, first step, ordered step], execution steps counted from 1. Reads are [frame of the
    timeline, entries, weights] of each chunk.
    """
    return {
        "id": episode_id(record),
        "task": record["task"],
        "episode": record["episode"],
        "seed": record.get("seed"),
        "referent": record.get("referent", "fixed"),
        "variant": _variant(record),
        "prompt": int(record.get("prompt_steps") or 0),
        "steps": int(record.get("steps") or _last_step(record)),
        "checkpoints": [[c["operation"], c["first_step"], c.get("ordered_step")] for c in record["checkpoints"]],
        "outcome": failure_of(record) or "success",
        "fault": record.get("fault"),
        "scene": record.get("scene_hash"),
        "video": video,
        "reads": [[chunk["step"], chunk["entries"], chunk["weights"]] for chunk in reads],
    }


def episode_id(record: Record) -> str:
    """Return a name that is the same in every run: task, episode, and the referent where it is not the published."""
    referent = record.get("referent", "fixed")
    return f"{record['task']}.{record['episode']}" + ("" if referent == "fixed" else f".{referent}")


def _last_step(record: Record) -> int:
    """The last step known of a log that does not say how long its rollouts were."""
    return max([1, *(c["first_step"] for c in record["checkpoints"] if c["first_step"] is not None)])
