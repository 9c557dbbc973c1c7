"""Several evaluations side by side, in the layout of the paper's main table: every memory type's rates in one row."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from lerobot_memobench.evaluation.documents.tables import Cell, Table, best_in_columns
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate
from lerobot_memobench.evaluation.metrics.summary import Summary
from lerobot_memobench.evaluation.records.runs import Run, unlike
from lerobot_memobench.tasks.task import MEMORY_TYPES

LEADING = ("evaluation", "inputs", "k")
"""Columns before the rates."""
NOTE = "inputs: of the policy; k: the replan interval."


def overview(runs: Sequence[Run]) -> Table:
    """Return one row per evaluation, and under the table in what they were not run alike."""
    rows = tuple(run_row(run) for run in runs)
    notes = unlike({run.name: run.protocol for run in runs})
    return wide_table("overview", "Evaluations", rows, note=" ".join([NOTE, *notes]), best=best_in_columns(rows))


def run_row(run: Run) -> tuple[Cell, ...]:
    """Return the row of an evaluation."""
    return (run.name, run.summary.inputs, run.replan_steps, *all_rates(run.summary))


def all_rates(summary: Summary) -> list[Rate]:
    """Return the metrics of every memory type and of the average, in the paper's order."""
    absent = dict.fromkeys(METRICS, Rate(None, 0))
    rows = [*(summary.memory_types.get(name, absent) for name in MEMORY_TYPES), summary.average]
    return [row[metric] for row in rows for metric in METRICS]


def wide_table(
    key: str,
    title: str,
    rows: tuple[tuple[Cell, ...], ...],
    leading: tuple[str, ...] = LEADING,
    note: str = NOTE,
    strong: Iterable[int] = (),
    rules: Iterable[int] = (),
    best: frozenset[tuple[int, int]] = frozenset(),
) -> Table:
    """Return a table whose rows are some leading cells and then `all_rates`."""
    return Table(
        key,
        title,
        (*leading, *(METRICS * (len(MEMORY_TYPES) + 1))),
        rows,
        note=note,
        groups=(*(("", 1) for _ in leading), *((name, len(METRICS)) for name in (*MEMORY_TYPES, "average"))),
        strong=frozenset(strong),
        rules=frozenset(rules),
        best=best,
        intervals=False,
    )
