"""The rows that figures are drawn from: one method at one replan interval, ours or the paper's alike."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from lerobot_memobench.evaluation.documents.beside_paper import extent
from lerobot_memobench.evaluation.metrics.rates import METRICS, Row
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.task import MEMORY_TYPES

Identity = tuple[str, bool]
"""(method, whether it is the paper's)."""

Figures = Mapping[str, float | None]
"""Metric -> per cent; None where it does not apply."""


@dataclass(frozen=True)
class Entry:
    """One method at one replan interval.

    Attributes:
        memory_types, tasks: name -> figures; the paper publishes none per task. published: whether it is the paper's.
        extent: how much was run, where that is less than the paper ran, "" else.
    """

    method: str
    replan_steps: int | None
    memory_types: Mapping[str, Figures]
    average: Figures
    tasks: Mapping[str, Figures]
    memory_type_of: Mapping[str, str]
    published: bool = False
    extent: str = ""

    @property
    def identity(self) -> Identity:
        """Whose row it is, whatever stands beside: an evaluation may be called like one of the paper's methods."""
        return self.method, self.published


def entries_of(runs: Sequence[Run]) -> list[Entry]:
    """Return the rows of evaluations."""
    found = []
    for run in runs:
        summary = run.summary
        types = {name: _figures(row) for name, row in summary.memory_types.items()}
        tasks = {name: _figures(row) for name, row in summary.tasks.items()}
        found.append(
            Entry(
                run.method,
                run.replan_steps,
                types,
                _figures(summary.average),
                tasks,
                summary.memory_type_of,
                extent=extent(run),
            )
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


def best_over_replan(entries: Iterable[Entry], axes: Sequence[Axis]) -> dict[Identity, list[float | None]]:
    """Return whose row -> per axis the highest figure over its replan intervals (the paper's rule for its radar)."""
    found: dict[Identity, list[float | None]] = {}
    for entry in entries:
        row = found.setdefault(entry.identity, [None] * len(axes))
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


def labels_of(entries: Sequence[Entry]) -> dict[Identity, str]:
    """Return what a row is called in a legend; beside one another, the paper's say so and ours how much was run."""
    beside = len({entry.published for entry in entries}) > 1
    extents: dict[Identity, list[str]] = {}
    for entry in entries:
        extents.setdefault(entry.identity, []).append(entry.extent)
    found = {}
    for (method, published), told in extents.items():
        all_told = "; ".join(dict.fromkeys(filter(None, told)))
        ours = f"{method}\n({all_told})" if beside and all_told else method
        found[method, published] = f"paper: {method}" if published and beside else ours
    return found
