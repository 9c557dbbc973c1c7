"""SR, MSR, MUR and MCR of rollouts, and their intervals (paper, section on metrics).

Rates are fractions in [0, 1]; `summary.report` turns them into percentages with one decimal. None stands for not
applicable: a task without checkpoints of an operation has no rate for it and leaves that average.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.rollouts import Record, operations, satisfied

PROCESS_METRICS: dict[str, str] = {"MSR": "S", "MUR": "U", "MCR": "C"}
"""Metric -> operation of the checkpoints it looks at."""

METRICS = ("SR", *PROCESS_METRICS)

Z95 = 1.959963984540054
"""Quantile of the normal distribution for two-sided 95 %."""


@dataclass(frozen=True)
class Rate:
    """A rate and how many rollouts it rests on.

    Attributes:
        value: fraction in [0, 1]; None when not applicable.
        n: rollouts. Checkpoints of one rollout depend on one another, so rollouts, not checkpoints, are counted, which
            makes the interval the wider one.
        effective: of a mean of rates, the number of rollouts of a plain rate with the same standard error; None where
            it is n.
    """

    value: float | None
    n: int
    effective: float | None = None

    @property
    def trials(self) -> float:
        """The number of trials that the interval is computed with."""
        return self.n if self.effective is None else self.effective

    @property
    def interval(self) -> tuple[float, float] | None:
        """Wilson's 95 % interval."""
        return None if self.value is None else wilson(self.value, self.trials)


Row = dict[str, Rate]
"""Metric -> rate."""


def wilson(rate: float, n: float, z: float = Z95) -> tuple[float, float]:
    """Return the Wilson score interval of a rate over ``n`` trials (95 % by default), within [0, 1].

    Written out although statsmodels has it: every report and every evaluation's end needs it, and importing statsmodels
    takes longer than all the rest of a report.
    """
    if n < 1 or not 0.0 <= rate <= 1.0:
        raise MemobenchError(f"a Wilson interval needs a rate in [0, 1] over at least one trial, got {rate} over {n}")
    centre = rate + z * z / (2 * n)
    spread = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def percent(value: float | None) -> float | None:
    """Return a fraction as a percentage with one decimal; None stays None."""
    return None if value is None else round(100.0 * value, 1)


# --- of rollouts ---


def success_rate(records: Sequence[Record]) -> Rate:
    """Return the share of rollouts that succeeded."""
    return Rate(sum(bool(record["success"]) for record in records) / len(records), len(records))


def task_row(records: Sequence[Record]) -> Row:
    """Return the metrics of one task's rollouts: the mean over rollouts of the mean over an operation's checkpoints."""
    row = {"SR": success_rate(records)}
    for metric, operation in PROCESS_METRICS.items():
        found = checkpoint_rate(records, operation)
        row[metric] = Rate(found.value, len(records) if found.n else 0)
    return row


def value_of(record: Record, metric: str) -> float | None:
    """Return what a rollout gives to a metric: success, or the share of its operation's checkpoints satisfied."""
    return (
        float(bool(record["success"])) if metric == "SR" else checkpoint_rate([record], PROCESS_METRICS[metric]).value
    )


def pooled_row(records: Sequence[Record]) -> Row:
    """Return SR over all rollouts, and MSR, MUR, MCR over all checkpoint records of the operation."""
    rates = {metric: checkpoint_rate(records, operation) for metric, operation in PROCESS_METRICS.items()}
    return {"SR": success_rate(records), **rates}


def checkpoint_rate(records: Iterable[Record], wanted: str) -> Rate:
    """Return the share of the checkpoint records of some operations that were satisfied; n counts records."""
    values = [
        done
        for record in records
        for operation, done in zip(operations(record), satisfied(record), strict=True)
        if operation in wanted
    ]
    return Rate(sum(values) / len(values) if values else None, len(values))


def column_rates(rows: Sequence[Sequence[bool]]) -> list[Rate]:
    """Return the share of (n, K) values that are true, (K,)."""
    return [Rate(sum(column) / len(rows), len(rows)) for column in zip(*rows, strict=True)]


# --- means ---


def mean_row(rows: Iterable[Row]) -> Row:
    """Return the mean of several rows, metric by metric, over those to which the metric applies."""
    rows = list(rows)
    return {metric: mean_rate([row[metric] for row in rows]) for metric in METRICS}


def mean_rate(rates: Iterable[Rate]) -> Rate:
    """Return the mean of the applicable rates, each of the same weight whatever its n.

    A mean of m rates over n₁ … n_m rollouts has the variance p(1 − p) · Σ 1/(m² n_i) where they share p, which is that
    of a plain rate over m² / Σ 1/n_i rollouts. With equal n_i this is their sum.
    """
    applicable = [rate for rate in rates if rate.value is not None]
    if not applicable:
        return Rate(None, 0)
    count, n = len(applicable), sum(rate.n for rate in applicable)
    mean = sum(rate.value for rate in applicable if rate.value is not None) / count
    trials = [rate.trials for rate in applicable]
    if 0 in trials:  # rates without rollouts, such as the paper's
        return Rate(mean, n)
    effective = count * count / sum(1 / each for each in trials)
    return Rate(mean, n, None if math.isclose(effective, n) else effective)
