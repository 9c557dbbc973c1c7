"""The shuffled memory control as a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.evaluation.comparison.estimates import as_percent, estimate, number
from lerobot_memobench.evaluation.comparison.prefix_rows import (
    PAPER,
    PAPER_TASK,
    prefix_header,
    prefix_row,
    replan_title,
)
from lerobot_memobench.evaluation.comparison.shuffled_memory import PrefixCurve
from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import Rate

SENTENCE = (
    "Rollouts in which a checkpoint and all before it were satisfied, per cent, with Wilson's 95 % interval. The "
    "difference is shuffled − normal, with its bootstrap interval over paired episodes."
)


def shuffled_report(
    found: Mapping[int | None, Sequence[PrefixCurve]], published: Mapping[str, Sequence[float]] | None = None
) -> Report:
    """Return prefix completion with normal and with shuffled memory per task, and their difference.

    Args:
        published: the paper's, per cent, ``normal`` and ``shuffled``.
    """
    tables = [_table(replan, curves) for replan, curves in found.items()]
    if published is not None:
        tables.append(_published_table(published))
    data: dict[str, Any] = {str(replan): as_percent(list(curves)) for replan, curves in found.items()}
    if published is not None:
        data[PAPER] = dict(published)
    return Report("Shuffled memory", (Section("", tuple(tables), sentences=(SENTENCE,)),), data)


def _table(replan: int | None, curves: Sequence[PrefixCurve]) -> Table:
    width = max(len(curve.normal) for curve in curves) - 1
    rows: list[tuple[Cell, ...]] = []
    for curve in curves:
        for memory, rates in (("normal", curve.normal), ("shuffled", curve.other)):
            rows.append(prefix_row(Name(curve.task), memory, [Rate(rate, curve.n) for rate in rates], width))
        change = [estimate(difference, sign=True) for difference in curve.differences]
        rows.append(prefix_row(Name(curve.task), "difference", change, width))
    return Table(f"shuffled_{replan}", replan_title(replan), prefix_header("memory", width), tuple(rows))


def _published_table(published: Mapping[str, Sequence[float]]) -> Table:
    """The last of the paper's three figures is that of the last checkpoint, which it calls final success too."""
    normal, shuffled = ([rate / 100.0 for rate in published[key]] for key in ("normal", "shuffled"))
    change = [b - a for a, b in zip(normal, shuffled, strict=True)]
    rows = [
        prefix_row(PAPER_TASK, memory, [*cells, cells[-1]], len(cells))
        for memory, cells in (
            ("normal", [number(rate) for rate in normal]),
            ("shuffled", [number(rate) for rate in shuffled]),
            ("difference", [number(rate, sign=True) for rate in change]),
        )
    ]
    return Table("shuffled_paper", PAPER, prefix_header("memory", len(normal)), tuple(rows))
