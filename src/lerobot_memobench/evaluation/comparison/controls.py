"""What the paper's controls tell, from episode logs: oracle memory, shuffled memory, annotation granularity.

Two evaluations are compared episode by episode: the same task and seed under both. Intervals are percentiles of a
bootstrap that draws episodes within each task and keeps the pairs together, so that what both share (an easy scene)
does not widen them. Rates are fractions here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.rates import METRICS, Record, by_task, prefix, satisfied
from lerobot_memobench.tasks.task import MEMORY_TYPES, OPERATIONS

AVERAGE = "average"
DRAWS = 2000
"""Bootstrap draws."""
LEAST_GAP = 0.01
"""Gap to 100 % under which a share of it is not given: one rollout would turn it round."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A figure and its 95 % interval; None where it does not apply."""

    value: float | None
    low: float | None = None
    high: float | None = None


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


def gap_closed(standard: float | None, other: float | None) -> float | None:
    """Return the share of the gap between ``standard`` and 1 that ``other`` closes (paper, oracle memory).

    Negative when the other is worse; None where a rate does not apply or the gap is under `LEAST_GAP`.
    """
    if standard is None or other is None or 1.0 - standard < LEAST_GAP:
        return None
    return (other - standard) / (1.0 - standard)


# --- pairs ---


def by_replan(records: Sequence[Record]) -> dict[int | None, list[Record]]:
    """Group rollouts by replan interval, ascending; unknown intervals last."""
    groups: dict[int | None, list[Record]] = {}
    for record in records:
        groups.setdefault(record.get("replan_steps"), []).append(record)
    return dict(sorted(groups.items(), key=lambda item: (item[0] is None, item[0] or 0)))


def paired(a: Sequence[Record], b: Sequence[Record]) -> tuple[list[Record], list[Record], int]:
    """Return the rollouts of episodes that both have, in one order, and how many of either had no partner.

    Raises:
        MemobenchError: no episode is in both, or one is in either of them twice.
    """
    tables = []
    for records in (a, b):
        table: dict[tuple[Any, ...], Record] = {}
        for record in records:
            key = (record["task"], record.get("referent", "fixed"), record["episode"], record.get("seed"))
            if key in table:
                raise MemobenchError(
                    f"episode {record['episode']} of {record['task']!r} was given twice under one replan interval; "
                    "name each evaluation once"
                )
            table[key] = record
        tables.append(table)
    common = [key for key in tables[0] if key in tables[1]]
    if not common:
        raise MemobenchError(
            f"the evaluations have no episode in common ({len(a)} and {len(b)} rollouts); compare evaluations of the "
            "same tasks, seeds and referent"
        )
    alone = len(tables[0]) + len(tables[1]) - 2 * len(common)
    return [tables[0][key] for key in common], [tables[1][key] for key in common], alone


# --- oracle memory ---


def contrasts(
    standard: Sequence[Record], other: Sequence[Record], draws: int = DRAWS, seed: int = 0
) -> dict[str, dict[str, Contrast]]:
    """Return, per memory type and on average, each metric under both evaluations; rollouts are paired already.

    A memory type is the mean over its applicable tasks, the average the mean over applicable memory types, as in every
    table of the benchmark.
    """
    points = [_rates(records, np.random.default_rng(seed), 0) for records in (standard, other)]
    # The same seed draws the same episodes of both.
    clouds = [_rates(records, np.random.default_rng(seed), draws) for records in (standard, other)]
    result: dict[str, dict[str, Contrast]] = {}
    for name, metrics in points[0].items():
        result[name] = {}
        for metric in metrics:
            a, b = (point[name][metric] for point in points)
            if a is None or b is None:
                result[name][metric] = Contrast(None, None, Estimate(None), Estimate(None))
                continue
            cloud = [samples[name][metric] for samples in clouds]
            assert cloud[0] is not None
            assert cloud[1] is not None
            result[name][metric] = _contrast(float(a[0]), float(b[0]), cloud[0], cloud[1])
    return result


def _contrast(a: float, b: float, many_a: Array, many_b: Array) -> Contrast:
    gap = 1.0 - many_a
    shares = (many_b - many_a)[gap >= LEAST_GAP] / gap[gap >= LEAST_GAP]
    value = gap_closed(a, b)
    # Where the gap vanishes in many draws, the share has no interval worth the name.
    closed = Estimate(value, *_percentiles(shares)) if value is not None and len(shares) > 0.9 * len(gap) else None
    return Contrast(a, b, Estimate(b - a, *_percentiles(many_b - many_a)), closed or Estimate(value))


def _percentiles(values: Array) -> tuple[float, float]:
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


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
    labels = [checkpoint["operation"] for checkpoint in group[0]["checkpoints"]]
    done = np.array([satisfied(record) for record in group], dtype=float).reshape(len(group), -1)
    values: dict[str, Array | None] = {"SR": np.array([float(bool(record["success"])) for record in group])}
    for metric, operation in METRICS.items():
        if operation is not None:
            places = [k for k, label in enumerate(labels) if label == operation]
            values[metric] = done[:, places].mean(axis=1) if places else None
    return values


def _mean(rows: Sequence[Mapping[str, Array | None]]) -> dict[str, Array | None]:
    result: dict[str, Array | None] = {}
    for metric in METRICS:
        known = [values for row in rows if (values := row[metric]) is not None]
        result[metric] = np.mean(known, axis=0) if known else None
    return result


def published_contrasts(table: Mapping[str, Any]) -> dict[str, dict[str, Contrast]]:
    """Return the contrasts of the published table (``oracle_memory`` of the paper's tables), without intervals.

    The average is the published one: its cells are rounded, so a mean of ours may differ in the last digit.
    """

    def fraction(value: float | None) -> float | None:
        return None if value is None else value / 100.0

    result: dict[str, dict[str, Contrast]] = {}
    for name in (*MEMORY_TYPES, AVERAGE):
        result[name] = {}
        for metric in METRICS:
            a, b = (fraction(table[key][name][metric]) for key in ("standard_pi05", "oracle_pi05"))
            difference = None if a is None or b is None else b - a
            result[name][metric] = Contrast(a, b, Estimate(difference), Estimate(gap_closed(a, b)))
    return result


# --- shuffled memory ---


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
        curves.append(
            PrefixCurve(
                task,
                tuple(a.mean(axis=0).tolist()),
                tuple(b.mean(axis=0).tolist()),
                tuple(Estimate(float(d), *_percentiles(step[:, k])) for k, d in enumerate(difference)),
                len(group),
            )
        )
    return curves


def _prefixes(group: Sequence[Record]) -> Array:
    return np.array([[*prefix(satisfied(record)), bool(record["success"])] for record in group], dtype=float)


# --- annotation granularity ---


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


def as_percent(value: Any) -> Any:
    """Return a dataclass, mapping, sequence or rate with every rate in per cent with one decimal, for JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return as_percent(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {key: as_percent(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_percent(item) for item in value]
    return round(100.0 * value, 1) if isinstance(value, float) else value
