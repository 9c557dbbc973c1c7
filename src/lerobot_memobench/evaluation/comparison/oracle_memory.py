"""What a perfect memory would recover: rates with and without oracle memory text, and the share of the gap it closes.

Two evaluations are compared episode by episode. A memory type is the mean over its applicable tasks, the average the
mean over applicable memory types, as in every table of the benchmark. Rates are fractions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_memobench.evaluation.comparison.control_tables import PAPER, replan_title
from lerobot_memobench.evaluation.comparison.estimates import (
    DRAWS,
    Array,
    Estimate,
    as_percent,
    difference_interval,
    estimate,
    newcombe,
    number,
    percentiles,
)
from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE, Cell, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import METRICS, value_of
from lerobot_memobench.evaluation.metrics.rollouts import Record, by_task
from lerobot_memobench.tasks.task import MEMORY_TYPES

AVERAGE = "average"
LEAST_GAP = 0.01
"""Gap to 100 % under which a share of it is not given: one rollout would turn it round."""


@dataclass(frozen=True)
class Contrast:
    """One metric of one memory type (or the average) under two evaluations.

    Attributes:
        standard, other: the rates.
        difference: other − standard.
        closed: (other − standard) / (1 − standard), the share of the gap to 100 % that the other closes.
    """

    standard: float | None
    other: float | None
    difference: Estimate
    closed: Estimate


Contrasts = dict[str, dict[str, Contrast]]
"""Memory type, or the average -> metric -> contrast."""


def gap_closed(standard: float | None, other: float | None) -> float | None:
    """Return the share of the gap between ``standard`` and 1 that ``other`` closes (paper, oracle memory).

    Negative when the other is worse; None where a rate does not apply or the gap is under `LEAST_GAP`.
    """
    if standard is None or other is None or 1.0 - standard < LEAST_GAP:
        return None
    return (other - standard) / (1.0 - standard)


def contrasts(standard: Sequence[Record], other: Sequence[Record], draws: int = DRAWS, seed: int = 0) -> Contrasts:
    """Return, per memory type and on average, each metric under both evaluations; rollouts are paired already."""
    points = [_rates(records, np.random.default_rng(seed), 0) for records in (standard, other)]
    # The same seed draws the same episodes of both.
    clouds = [_rates(records, np.random.default_rng(seed), draws) for records in (standard, other)]
    return {
        name: {
            metric: _contrast(
                _pairs(standard, other, name, metric),
                *(point[name][metric] for point in points),
                *(cloud[name][metric] for cloud in clouds),
            )
            for metric in metrics
        }
        for name, metrics in points[0].items()
    }


def _pairs(standard: Sequence[Record], other: Sequence[Record], scope: str, metric: str) -> tuple[Array, Array, Array]:
    """Return each pair's two values and its weight in the mean of a scope, (n,) each, where the metric applies."""
    groups: dict[str, list[tuple[Array, Array]]] = {}
    others = by_task(other)
    for task, group in by_task(standard).items():
        kind = str(group[0]["memory_type"])
        a, b = _values(group)[metric], _values(others[task])[metric]
        if scope in (kind, AVERAGE) and a is not None and b is not None:
            groups.setdefault(kind, []).append((a, b))
    parts = [
        (a, b, np.full(len(a), 1 / (len(groups) * len(tasks) * len(a)))) for tasks in groups.values() for a, b in tasks
    ]
    if not parts:
        return np.empty(0), np.empty(0), np.empty(0)
    a, b, weights = (np.concatenate(column) for column in zip(*parts, strict=True))
    return a, b, weights


def _contrast(
    pairs: tuple[Array, Array, Array],
    a: Array | None,
    b: Array | None,
    many_a: Array | None,
    many_b: Array | None,
) -> Contrast:
    """Return what pairs, their rates, (1,), and bootstrap draws of these, (draws,), say of two evaluations."""
    if a is None or b is None or many_a is None or many_b is None:
        return Contrast(None, None, Estimate(None), Estimate(None))
    gap = 1.0 - many_a
    shares = (many_b - many_a)[gap >= LEAST_GAP] / gap[gap >= LEAST_GAP]
    closed = Estimate(gap_closed(float(a[0]), float(b[0])))
    # Where the gap vanishes in many draws, the share has no interval worth the name.
    if closed.value is not None and len(shares) > 0.9 * len(gap):
        least, most = (bound / (1.0 - float(a[0])) for bound in newcombe(*pairs))
        low, high = percentiles(shares)
        closed = Estimate(closed.value, min(low, least), min(max(high, most), 1.0))
    difference = Estimate(float(b[0]) - float(a[0]), *difference_interval(many_b - many_a, *pairs))
    return Contrast(float(a[0]), float(b[0]), difference, closed)


def _rates(records: Sequence[Record], rng: np.random.Generator, draws: int) -> dict[str, dict[str, Array | None]]:
    """Return rates per memory type and average, each (draws,), or (1,) as they are when ``draws`` is 0."""
    tasks: dict[str, list[dict[str, Array | None]]] = {}
    for group in by_task(records).values():
        chosen = rng.integers(len(group), size=(draws, len(group))) if draws else np.arange(len(group))[None]
        tasks.setdefault(str(group[0]["memory_type"]), []).append(
            {
                metric: None if values is None else values[chosen].mean(axis=1)
                for metric, values in _values(group).items()
            }
        )
    rates: dict[str, dict[str, Array | None]] = {name: _mean(tasks[name]) for name in MEMORY_TYPES if name in tasks}
    return {**rates, AVERAGE: _mean(list(rates.values()))}


def _values(group: Sequence[Record]) -> dict[str, Array | None]:
    """Return each metric of each rollout of one task, (n,); None for an operation that the task has not."""
    values: dict[str, Array | None] = {}
    for metric in METRICS:
        found = [value_of(record, metric) for record in group]
        values[metric] = None if None in found else np.array(found, dtype=float)
    return values


def _mean(rows: Sequence[Mapping[str, Array | None]]) -> dict[str, Array | None]:
    result: dict[str, Array | None] = {}
    for metric in METRICS:
        known = [values for row in rows if (values := row[metric]) is not None]
        result[metric] = np.mean(known, axis=0) if known else None
    return result


def published_contrasts(table: Mapping[str, Any]) -> Contrasts:
    """Return the contrasts of the published table (``oracle_memory`` of the paper's tables), without intervals.

    The average is the published one: its cells are rounded, so a mean of ours may differ in the last digit.
    """
    return {
        name: {
            metric: _published(*(table[key][name][metric] for key in ("standard_pi05", "oracle_pi05")))
            for metric in METRICS
        }
        for name in (*MEMORY_TYPES, AVERAGE)
    }


def _published(standard: float | None, oracle: float | None) -> Contrast:
    """Return a contrast of two published percentages."""
    a, b = (None if value is None else value / 100.0 for value in (standard, oracle))
    difference = None if a is None or b is None else b - a
    return Contrast(a, b, Estimate(difference), Estimate(gap_closed(a, b)))


# --- the report ---

SENTENCE = (
    "Cells are standard/oracle in per cent. Gap closed is (oracle − standard)/(100 − standard), with "
    "the 95 % interval of a bootstrap over paired episodes, at least Newcombe's of so many; – where an operation "
    "does not occur, or the gap is under one point."
)


def oracle_report(found: Mapping[int | None, Contrasts], paper: tuple[int, Contrasts] | None = None) -> Report:
    """Return the decomposition, one table per replan interval.

    Args:
        paper: the published contrasts and their replan interval; in rows of their own under ours of that interval, or
            in a table of their own.
    """
    tables, data = [], {}
    for replan, contrasts in found.items():
        beside = paper[1] if paper is not None and replan == paper[0] else None
        tables.append(_table(replan, contrasts, beside))
        data[str(replan)] = as_percent(contrasts)
    if paper is not None:
        data[PAPER] = as_percent(paper[1])
        if paper[0] not in found:
            tables.append(_table(paper[0], paper[1], None, f", {PAPER}"))
    return Report("Oracle memory decomposition", (Section("", tuple(tables), sentences=(SENTENCE,)),), data)


def _table(replan: int | None, found: Contrasts, beside: Contrasts | None, suffix: str = "") -> Table:
    rows: list[tuple[Cell, ...]] = []
    strong = set()
    for name, metrics in found.items():
        if name == AVERAGE:
            strong.add(len(rows))
        rows.append((name, *_cells(metrics)))
        if beside is not None and name in beside:
            rows.append((f"{name}, {PAPER}", *_cells(beside[name])))
    header = ("memory type", *METRICS, *(f"{metric} gap closed" for metric in METRICS))
    return Table(f"oracle_{replan}", replan_title(replan) + suffix, header, tuple(rows), strong=frozenset(strong))


def _cells(metrics: Mapping[str, Contrast]) -> list[Cell]:
    pairs = [
        NOT_APPLICABLE if metrics[m].standard is None else f"{number(metrics[m].standard)}/{number(metrics[m].other)}"
        for m in METRICS
    ]
    return [*pairs, *(estimate(metrics[m].closed) for m in METRICS)]
