"""Does a policy need its subgoals in order? How far rollouts come with normal and with shuffled memory."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_memobench.evaluation.comparison.control_tables import (
    PAPER,
    PAPER_TASK,
    prefix_header,
    prefix_row,
    replan_title,
)
from lerobot_memobench.evaluation.comparison.estimates import (
    DRAWS,
    Array,
    Estimate,
    as_percent,
    difference_interval,
    estimate,
    number,
)
from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import Rate
from lerobot_memobench.evaluation.metrics.rollouts import Record, by_task, prefix, satisfied


@dataclass(frozen=True)
class PrefixCurve:
    """Prefix completion of one task under two evaluations, (K + 1,): each checkpoint, then success.

    Attributes:
        normal, other: rates.
        differences: other − normal.
        n: episodes.
    """

    task: str
    normal: tuple[float, ...]
    other: tuple[float, ...]
    differences: tuple[Estimate, ...]
    n: int


def prefix_curves(
    normal: Sequence[Record], other: Sequence[Record], draws: int = DRAWS, seed: int = 0
) -> list[PrefixCurve]:
    """Return how far the rollouts of both come, per task; rollouts are paired already.

    A checkpoint counts when it and all before it were satisfied at some step (paper, prefix completion); the last entry
    is success.
    """
    curves = []
    others = by_task(other)
    for task, group in by_task(normal).items():
        a, b = _prefixes(group), _prefixes(others[task])
        chosen = np.random.default_rng(seed).integers(len(group), size=(draws, len(group)))
        step = (b - a)[chosen].mean(axis=1)
        difference = (b - a).mean(axis=0)
        weights = np.full(len(group), 1 / len(group))
        curves.append(
            PrefixCurve(
                task,
                tuple(a.mean(axis=0).tolist()),
                tuple(b.mean(axis=0).tolist()),
                tuple(
                    Estimate(float(d), *difference_interval(step[:, k], a[:, k], b[:, k], weights))
                    for k, d in enumerate(difference)
                ),
                len(group),
            )
        )
    return curves


def _prefixes(group: Sequence[Record]) -> Array:
    return np.array([[*prefix(satisfied(record)), bool(record["success"])] for record in group], dtype=float)


# --- the report ---

SENTENCE = (
    "Rollouts in which a checkpoint and all before it were satisfied, per cent, with Wilson's 95 % interval. The "
    "difference is shuffled − normal, with its bootstrap interval over paired episodes, "
    "at least Newcombe's of so many pairs."
)
SEVERAL = 3
"""Subgoals of a task that can change places in more than one way."""
ELSEWHERE = (
    f"Fewer than {SEVERAL} subgoals that change places are only renamed, and still tell what is seen: such a task is "
    "taught subgoals of other episodes in their place."
)


def shuffled_report(
    found: Mapping[int | None, Sequence[PrefixCurve]], published: Mapping[str, Sequence[float]] | None = None
) -> Report:
    """Return prefix completion with normal and with shuffled memory per task, and their difference.

    Args:
        published: the paper's, per cent, ``normal`` and ``shuffled``.
    """
    tables = [_table(replan, curves) for replan, curves in found.items()]
    short = {curve.task for curves in found.values() for curve in curves if len(curve.normal) <= SEVERAL}
    said = f"{ELSEWHERE} So it was with {', '.join(sorted(short))}." if short else ""
    if published is not None:
        tables.append(_published_table(published))
    data: dict[str, Any] = {str(replan): as_percent(list(curves)) for replan, curves in found.items()}
    if published is not None:
        data[PAPER] = dict(published)
    sentences = (SENTENCE, said) if said else (SENTENCE,)
    return Report("Shuffled memory", (Section("", tuple(tables), sentences=sentences),), data)


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
