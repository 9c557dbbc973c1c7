"""Oracle and shuffled memory, each against the policy as it is, episode by episode.

Oracle memory: what a perfect memory would recover, as the share of the gap to 100 % that it closes. Shuffled memory:
does a policy need its subgoals in order? A memory type is the mean over its applicable tasks, the average the mean over
applicable memory types, as in every table of the benchmark. Rates are fractions.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.controls import PAPER, PAPER_TASK, prefix_header, prefix_row, replan_title
from lerobot_memobench.evaluation.metrics import METRICS, Rate, Record, by_task, percent, prefix, satisfied, value_of
from lerobot_memobench.evaluation.statistics import (
    DRAWS,
    Array,
    Estimate,
    difference_interval,
    newcombe,
    percentiles,
)
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, Cell, Name, Report, Section, Table, figure
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


@dataclass(frozen=True)
class Outcomes:
    """One metric of one task's paired rollouts: (n,) of either evaluation, and the episodes that are drawn, (D, n)."""

    a: Array
    b: Array
    drawn: NDArray[np.intp]


def paired_outcomes(
    standard: Sequence[Record], other: Sequence[Record], draws: int = DRAWS
) -> dict[str, dict[str, Outcomes]]:
    """Return task -> applicable metric -> its outcomes under both evaluations; rollouts are paired already."""
    rng = np.random.default_rng(0)
    others = by_task(other)
    found: dict[str, dict[str, Outcomes]] = {}
    for task, group in by_task(standard).items():
        drawn = rng.integers(len(group), size=(draws, len(group)))
        found[task] = {}
        for metric in METRICS:
            a, b = ([value_of(record, metric) for record in records] for records in (group, others[task]))
            if None not in (*a, *b):
                found[task][metric] = Outcomes(np.array(a, dtype=float), np.array(b, dtype=float), drawn)
    return found


def contrasts(standard: Sequence[Record], other: Sequence[Record], draws: int = DRAWS) -> Contrasts:
    """Return, per memory type and on average, each metric under both evaluations; rollouts are paired already."""
    return contrasts_by_type(paired_outcomes(standard, other, draws), standard)


def contrasts_by_type(outcomes: Mapping[str, Mapping[str, Outcomes]], records: Sequence[Record]) -> Contrasts:
    """Return the contrasts of each memory type and on average, of tasks whose memory types rollouts tell."""
    kinds = grouped(outcomes, {record["task"]: str(record["memory_type"]) for record in records})
    scopes = {**{name: [tasks] for name, tasks in kinds.items()}, AVERAGE: list(kinds.values())}
    return {name: contrasts_of(groups) for name, groups in scopes.items()}


def grouped(
    outcomes: Mapping[str, Mapping[str, Outcomes]], group_of: Mapping[str, str]
) -> dict[str, list[Mapping[str, Outcomes]]]:
    """Return group -> the outcomes of its tasks; tasks that are in none are left out."""
    groups: dict[str, list[Mapping[str, Outcomes]]] = {}
    for task, metrics in outcomes.items():
        if task in group_of:
            groups.setdefault(group_of[task], []).append(metrics)
    return groups


def contrasts_of(groups: Sequence[Sequence[Mapping[str, Outcomes]]]) -> dict[str, Contrast]:
    """Return metric -> contrast of groups of tasks: the mean over applicable groups of means over their tasks."""
    return {
        metric: _contrast([[task[metric] for task in tasks if metric in task] for tasks in groups])
        for metric in METRICS
    }


def _contrast(groups: Sequence[Sequence[Outcomes]]) -> Contrast:
    """Return what memory types of tasks of paired outcomes say of two evaluations: a mean of means, with bootstrap."""
    known = [tasks for tasks in groups if tasks]
    if not known:
        return Contrast(None, None, Estimate(None), Estimate(None))

    def mean(value: Callable[[Outcomes], Any]) -> Any:
        return np.mean([np.mean([value(task) for task in tasks], axis=0) for tasks in known], axis=0)

    a, b = float(mean(lambda task: task.a.mean())), float(mean(lambda task: task.b.mean()))
    many_a = mean(lambda task: task.a[task.drawn].mean(axis=1))
    many_b = mean(lambda task: task.b[task.drawn].mean(axis=1))
    parts = [(task.a, task.b, 1 / (len(known) * len(tasks) * len(task.a))) for tasks in known for task in tasks]
    pairs = (
        np.concatenate([a for a, _, _ in parts]),
        np.concatenate([b for _, b, _ in parts]),
        np.concatenate([np.full(len(a), weight) for a, _, weight in parts]),
    )
    gap = 1.0 - many_a
    shares = (many_b - many_a)[gap >= LEAST_GAP] / gap[gap >= LEAST_GAP]
    closed = Estimate(gap_closed(a, b))
    # Where the gap vanishes in many draws, the share has no interval worth the name.
    if closed.value is not None and len(shares) > 0.9 * len(gap):
        least, most = (bound / (1.0 - a) for bound in newcombe(*pairs))
        low, high = percentiles(shares)
        closed = Estimate(closed.value, min(low, least), min(max(high, most), 1.0))
    return Contrast(a, b, Estimate(b - a, *difference_interval(many_b - many_a, *pairs)), closed)


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


# --- oracle memory: the report ---

ORACLE_SENTENCE = (
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
        tables.append(_oracle_table(replan, contrasts, beside))
        data[str(replan)] = _as_percent(contrasts)
    if paper is not None:
        data[PAPER] = _as_percent(paper[1])
        if paper[0] not in found:
            tables.append(_oracle_table(paper[0], paper[1], None, f", {PAPER}"))
    return Report("Oracle memory decomposition", (Section("", tuple(tables), sentences=(ORACLE_SENTENCE,)),), data)


def _oracle_table(replan: int | None, found: Contrasts, beside: Contrasts | None, suffix: str = "") -> Table:
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
        NOT_APPLICABLE if metrics[m].standard is None else f"{figure(metrics[m].standard)}/{figure(metrics[m].other)}"
        for m in METRICS
    ]
    return [*pairs, *(_estimate(metrics[m].closed) for m in METRICS)]


def _estimate(found: Estimate, sign: bool = False) -> str:
    if found.low is None or found.high is None:
        return figure(found.value, sign)
    return f"{figure(found.value, sign)} [{figure(found.low, sign)}, {figure(found.high, sign)}]"


def _as_percent(value: Any) -> Any:
    """Return a dataclass, mapping, sequence or rate with every rate in per cent, for JSON."""
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {key: _as_percent(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_as_percent(item) for item in value]
    return percent(value) if isinstance(value, float) else value


# --- shuffled memory: prefix completion ---


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


def prefix_curves(normal: Sequence[Record], other: Sequence[Record], draws: int = DRAWS) -> list[PrefixCurve]:
    """Return how far the rollouts of both come, per task; rollouts are paired already.

    A checkpoint counts when it and all before it were satisfied at some step (paper, prefix completion); the last entry
    is success.
    """
    curves = []
    others = by_task(other)
    for task, group in by_task(normal).items():
        a, b = _prefixes(group), _prefixes(others[task])
        chosen = np.random.default_rng(0).integers(len(group), size=(draws, len(group)))
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


# --- shuffled memory: the report ---

SHUFFLED_SENTENCE = (
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
    tables = [_shuffled_table(replan, curves) for replan, curves in found.items()]
    data: dict[str, Any] = {str(replan): _as_percent(curves) for replan, curves in found.items()}
    if published is not None:
        tables.append(_published_table(published))
        data[PAPER] = dict(published)
    sentences = [SHUFFLED_SENTENCE]
    if short := {curve.task for curves in found.values() for curve in curves if len(curve.normal) <= SEVERAL}:
        sentences.append(f"{ELSEWHERE} So it was with {', '.join(sorted(short))}.")
    return Report("Shuffled memory", (Section("", tuple(tables), sentences=tuple(sentences)),), data)


def _shuffled_table(replan: int | None, curves: Sequence[PrefixCurve]) -> Table:
    width = max(len(curve.normal) for curve in curves) - 1
    rows: list[tuple[Cell, ...]] = []
    for curve in curves:
        for memory, rates in (("normal", curve.normal), ("shuffled", curve.other)):
            rows.append(prefix_row(Name(curve.task), memory, [Rate(rate, curve.n) for rate in rates], width))
        change = [_estimate(difference, sign=True) for difference in curve.differences]
        rows.append(prefix_row(Name(curve.task), "difference", change, width))
    return Table(f"shuffled_{replan}", replan_title(replan), prefix_header("memory", width), tuple(rows))


def _published_table(published: Mapping[str, Sequence[float]]) -> Table:
    """The last of the paper's three figures is that of the last checkpoint, which it calls final success too."""
    normal, shuffled = ([rate / 100.0 for rate in published[key]] for key in ("normal", "shuffled"))
    change = [b - a for a, b in zip(normal, shuffled, strict=True)]
    rows = [
        prefix_row(PAPER_TASK, memory, [*cells, cells[-1]], len(cells))
        for memory, cells in (
            ("normal", [figure(rate) for rate in normal]),
            ("shuffled", [figure(rate) for rate in shuffled]),
            ("difference", [figure(rate, sign=True) for rate in change]),
        )
    ]
    return Table("shuffled_paper", PAPER, prefix_header("memory", len(normal)), tuple(rows))
