"""Does it matter how finely subgoals are told? Metrics by the language level that a policy was taught with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison.control_tables import PAPER_TASK, prefix_header, prefix_row
from lerobot_memobench.evaluation.comparison.estimates import as_percent
from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import METRICS, PROCESS_METRICS, Rate, Row
from lerobot_memobench.evaluation.metrics.rollouts import Record
from lerobot_memobench.evaluation.metrics.summary import Summary, summarise
from lerobot_memobench.tasks.task import OPERATIONS

PAPER_GRANULARITY = {"coarse": (4, 50), "intermediate": (3, 50), "fine": (3, 50)}
"""Successful rollouts of that task by subgoal level (paper, annotation granularity; said in its text only)."""

SENTENCE = (
    "Per cent with Wilson's 95 % interval over rollouts. MSR, MUR and MCR are averages over memory types, under "
    "the evaluated (intermediate) labels and under those of the level itself."
)

Levels = Mapping[str, Sequence[Record]]
"""Level -> rollouts of the policy that was taught at it."""

Summaries = Mapping[str, Summary]


def relabelled(records: Sequence[Record], labels: Mapping[str, Sequence[str]]) -> list[Record]:
    """Return rollouts with the operation labels of another language level; tasks without labels keep theirs.

    Args:
        labels: task → operation per checkpoint ("S", "U" or "C").
    """
    result: list[Record] = []
    for record in records:
        operations = labels.get(record["task"])
        if operations is None:
            result.append(record)
            continue
        if len(operations) != len(record["checkpoints"]) or not set(operations) <= set(OPERATIONS):
            raise MemobenchError(
                f"a rollout of {record['task']!r} has {len(record['checkpoints'])} checkpoints, its labels are "
                f"{', '.join(operations)}; the log was written by another version of the task"
            )
        checkpoints = [
            {**checkpoint, "operation": operation}
            for checkpoint, operation in zip(record["checkpoints"], operations, strict=True)
        ]
        result.append({**record, "checkpoints": checkpoints})
    return result


def granularity_report(levels: Levels, own_labels: Levels, paper: bool = False) -> Report:
    """Return metrics by language level and prefix completion by level.

    Args:
        levels: with the evaluated (intermediate) labels. own_labels: with the level's own.
        paper: add the published successes.
    """
    summaries = {level: summarise(records) for level, records in levels.items()}
    own = {level: summarise(records) for level, records in own_labels.items()}
    tables = (_rates(summaries, own), _prefixes(summaries, paper))
    data = {level: _data(summary, own[level]) for level, summary in summaries.items()}
    return Report("Annotation granularity", (Section("", tables, sentences=(SENTENCE,)),), data)


def _rates(summaries: Summaries, own: Summaries) -> Table:
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            level,
            *(summary.average[metric] for metric in METRICS),
            *(own[level].average[metric] for metric in PROCESS_METRICS),
        )
        for level, summary in summaries.items()
    )
    header = ("level", *METRICS, *(f"{metric}, own labels" for metric in PROCESS_METRICS))
    return Table("granularity", "metrics by level", header, rows)


def _prefixes(summaries: Summaries, paper: bool) -> Table:
    width = max(len(rates) for summary in summaries.values() for rates in summary.prefix.values())
    names = dict.fromkeys(task for summary in summaries.values() for task in summary.tasks)
    rows: list[tuple[Cell, ...]] = [
        prefix_row(Name(task), level, [*summary.prefix[task], summary.tasks[task]["SR"]], width)
        for task in names
        for level, summary in summaries.items()
        if task in summary.tasks
    ]
    if paper:
        for level, (good, n) in PAPER_GRANULARITY.items():
            rows.append(prefix_row(PAPER_TASK, level, [*([None] * width), Rate(good / n, n)], width))
    return Table("granularity_prefix", "prefix completion by level", prefix_header("level", width), tuple(rows))


def _data(summary: Summary, own: Summary) -> dict[str, Any]:
    return {
        "n": summary.rollouts,
        "average": _plain(summary.average),
        "own_labels": _plain(own.average),
        "tasks": {
            task: {
                "SR": as_percent(row["SR"].value),
                "prefix": as_percent([rate.value for rate in summary.prefix[task]]),
            }
            for task, row in summary.tasks.items()
        },
    }


def _plain(row: Row) -> dict[str, float | None]:
    return {metric: as_percent(rate.value) for metric, rate in row.items()}
