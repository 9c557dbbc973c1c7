"""The rows that figures are drawn from: one method at one replan interval, ours or the paper's alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from lerobot_memobench.evaluation.metrics.rates import METRICS, Row
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.task import MEMORY_TYPES

Figures = Mapping[str, float | None]
"""Metric -> per cent; None where it does not apply."""


@dataclass(frozen=True)
class Entry:
    """One method at one replan interval.

    Attributes:
        memory_types, tasks: name -> figures; the paper publishes none per task. published: whether it is the paper's.
    """

    method: str
    replan_steps: int | None
    memory_types: Mapping[str, Figures]
    average: Figures
    tasks: Mapping[str, Figures]
    memory_type_of: Mapping[str, str]
    published: bool = False


def entries_of(runs: Sequence[Run]) -> list[Entry]:
    """Return the rows of evaluations."""
    found = []
    for run in runs:
        summary = run.summary
        types = {name: _figures(row) for name, row in summary.memory_types.items()}
        tasks = {name: _figures(row) for name, row in summary.tasks.items()}
        found.append(
            Entry(run.method, run.replan_steps, types, _figures(summary.average), tasks, summary.memory_type_of)
        )
    return found


def published_entries(*tables: str) -> list[Entry]:
    """Return the rows of some of the paper's tables."""
    return [
        Entry(row.label, row.replan_steps, row.memory_types, row.average, {}, {}, published=True)
        for row in published_rows(*tables)
    ]


def _figures(row: Row) -> dict[str, float | None]:
    return {metric: None if (value := row[metric].value) is None else 100 * value for metric in METRICS}


Axis = tuple[str | None, str]
"""(memory type, metric); None for the average."""


def best_over_replan(entries: Iterable[Entry], axes: Sequence[Axis]) -> dict[str, list[float | None]]:
    """Return method -> per axis the highest figure over its replan intervals (the paper's rule for its radar)."""
    found: dict[str, list[float | None]] = {}
    for entry in entries:
        row = found.setdefault(entry.method, [None] * len(axes))
        for k, (memory_type, metric) in enumerate(axes):
            figures = entry.average if memory_type is None else entry.memory_types.get(memory_type, {})
            value, so_far = figures.get(metric), row[k]
            if value is not None and (so_far is None or value > so_far):
                row[k] = value
    return found


def average_axes() -> list[Axis]:
    """Return the metrics of the average."""
    return [(None, metric) for metric in METRICS]


def type_axes() -> list[Axis]:
    """Return the metrics of each memory type."""
    return [(memory_type, metric) for memory_type in MEMORY_TYPES for metric in METRICS]
