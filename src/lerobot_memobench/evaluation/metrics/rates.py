"""From rollouts to SR, MSR, MUR and MCR (spec: benchmark.md, "Metrics"; paper, section on metrics).

A record is one line of the episode log. Rates are fractions in [0, 1] in this module; ``report`` turns them
into percentages with one decimal. None stands for not applicable: a task without checkpoints of an operation
has no rate for it and leaves that average.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.failures import failure_counts
from lerobot_memobench.tasks.task import MEMORY_TYPES

Record = Mapping[str, Any]

#: Metric -> operation of the checkpoints it looks at (None: success).
METRICS: dict[str, str | None] = {"SR": None, "MSR": "S", "MUR": "U", "MCR": "C"}


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


def wilson(rate: float, n: float, z: float = 1.959963984540054) -> tuple[float, float]:
    """Return the Wilson score interval of a rate over ``n`` trials (95 % by default), within [0, 1]."""
    if n < 1 or not 0.0 <= rate <= 1.0:
        raise MemobenchError(f"a Wilson interval needs a rate in [0, 1] over at least one trial, got {rate} over {n}")
    centre = rate + z * z / (2 * n)
    spread = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


# --- one rollout ---


def satisfied(record: Record) -> list[bool]:
    """Return per checkpoint whether its predicate held at some step of the execution, (K,)."""
    return [checkpoint["first_step"] is not None for checkpoint in record["checkpoints"]]


def completed_in_order(record: Record) -> list[bool]:
    """Return per checkpoint whether it held while all earlier ones were complete, (K,)."""
    return [checkpoint.get("ordered_step") is not None for checkpoint in record["checkpoints"]]


def prefix(values: Sequence[bool]) -> list[bool]:
    """Return per checkpoint whether it and all earlier ones are true, (K,)."""
    result: list[bool] = []
    for value in values:
        result.append(bool(value) and (not result or result[-1]))
    return result


# --- aggregation ---


def by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by task, in the order of memory types and then of names."""
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record["task"], []).append(record)
    order = {memory_type: k for k, memory_type in enumerate(MEMORY_TYPES)}
    for name, group in grouped.items():
        for what in ("memory_type", "operations"):
            found = {_operations(r) if what == "operations" else r["memory_type"] for r in group}
            if len(found) > 1:
                raise MemobenchError(
                    f"rollouts of {name!r} disagree on their {what} ({', '.join(sorted(found))}); "
                    "report logs of different versions of a task separately"
                )
        if group[0]["memory_type"] not in order:
            raise MemobenchError(
                f"rollouts of {name!r} have the memory type {group[0]['memory_type']!r}; expected one of "
                + ", ".join(MEMORY_TYPES)
            )
    return dict(sorted(grouped.items(), key=lambda item: (order[item[1][0]["memory_type"]], item[0])))


def _operations(record: Record) -> str:
    return "".join(checkpoint["operation"] for checkpoint in record["checkpoints"])


def task_row(records: Sequence[Record]) -> Row:
    """Return the metrics of one task's rollouts: r_o is the mean over rollouts of the mean over checkpoints
    of o.
    """
    n = len(records)
    row = {"SR": Rate(sum(bool(record["success"]) for record in records) / n, n)}
    operations = _operations(records[0])
    for metric, operation in METRICS.items():
        if operation is None:
            continue
        places = [k for k, label in enumerate(operations) if label == operation]
        if not places:
            row[metric] = Rate(None, 0)
            continue
        values = [satisfied(record) for record in records]
        row[metric] = Rate(sum(value[k] for value in values for k in places) / (n * len(places)), n)
    return row


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


@dataclass(frozen=True)
class Summary:
    """All figures of a set of rollouts.

    Attributes:
        tasks, memory_types: name -> metrics; a memory type is the mean over its applicable tasks.
        average: mean over the applicable memory types.
        pooled: MSR, MUR, MCR over all checkpoint records of the operation, whatever the task; n counts records.
        pooled_checkpoints: the same over all checkpoint records, whatever the operation.
        prefix, ordered_prefix: task -> per checkpoint the rate of rollouts in which it and all earlier ones were
            satisfied, in any order and in order.
        failures: class -> number of failed rollouts.
        failures_of: the same by task.
        memory_type_of: task -> memory type.
        operations_of: task -> its checkpoints' labels, such as "SUU".
    """

    tasks: dict[str, Row]
    memory_types: dict[str, Row]
    average: Row
    pooled: Row
    pooled_checkpoints: Rate
    prefix: dict[str, list[Rate]]
    ordered_prefix: dict[str, list[Rate]]
    failures: dict[str, int]
    failures_of: dict[str, dict[str, int]]
    memory_type_of: dict[str, str]
    operations_of: dict[str, str]

    @property
    def rollouts(self) -> int:
        return self.pooled["SR"].n


def summarise(records: Iterable[Record]) -> Summary:
    """Compute every figure of a set of rollouts."""
    records = list(records)
    if not records:
        raise MemobenchError("there are no rollouts to report; run an evaluation first")
    groups = by_task(records)
    tasks = {name: task_row(group) for name, group in groups.items()}
    memory_type_of = {name: str(group[0]["memory_type"]) for name, group in groups.items()}
    memory_types: dict[str, Row] = {
        memory_type: mean_row(tasks[name] for name in tasks if memory_type_of[name] == memory_type)
        for memory_type in MEMORY_TYPES
        if memory_type in memory_type_of.values()
    }
    return Summary(
        tasks=tasks,
        memory_types=memory_types,
        average=mean_row(memory_types.values()),
        pooled=pooled_row(records),
        pooled_checkpoints=_pooled(records, "SUC"),
        prefix={name: _column_rates([prefix(satisfied(r)) for r in group]) for name, group in groups.items()},
        ordered_prefix={
            name: _column_rates([prefix(completed_in_order(r)) for r in group]) for name, group in groups.items()
        },
        failures=failure_counts(records),
        failures_of={name: failure_counts(group) for name, group in groups.items()},
        memory_type_of=memory_type_of,
        operations_of={name: _operations(group[0]) for name, group in groups.items()},
    )


def pooled_row(records: Sequence[Record]) -> Row:
    """Return SR over all rollouts, and MSR, MUR, MCR over all checkpoint records of the operation."""
    row = {"SR": Rate(sum(bool(record["success"]) for record in records) / len(records), len(records))}
    row |= {metric: _pooled(records, operation) for metric, operation in METRICS.items() if operation is not None}
    return row


def _pooled(records: Sequence[Record], operations: str) -> Rate:
    """Return the share of the checkpoint records of some operations that were satisfied; n counts records."""
    values = [
        done
        for record in records
        for checkpoint, done in zip(record["checkpoints"], satisfied(record), strict=True)
        if checkpoint["operation"] in operations
    ]
    return Rate(sum(values) / len(values) if values else None, len(values))


def _column_rates(rows: Sequence[Sequence[bool]]) -> list[Rate]:
    return [Rate(sum(column) / len(rows), len(rows)) for column in zip(*rows, strict=True)]


#: Fields of a record that should agree within one report, and what they are called.
PROTOCOL = {"referent": "referent settings", "replan_steps": "replan intervals"}


def mixtures(records: Iterable[Record]) -> list[str]:
    """Return one sentence for each part of the protocol in which the rollouts differ: their mean mixes unlike
    things.
    """
    records = list(records)
    notes = []
    for field, words in PROTOCOL.items():
        found = sorted({str(record.get(field)) for record in records})
        if len(found) > 1:
            notes.append(f"The rollouts mix {words} ({', '.join(found)}); the figures are over all of them.")
    return notes


# --- report.json ---


def percent(value: float | None) -> float | None:
    """Return a fraction as a percentage with one decimal; None stays None."""
    return None if value is None else round(100.0 * value, 1)


def report(summary: Summary) -> dict[str, Any]:
    """Return the content of ``report.json``: percentages with one decimal, null where not applicable."""

    def entry(row: Row) -> dict[str, Any]:
        return {"n": row["SR"].n, **{metric: percent(row[metric].value) for metric in METRICS}}

    return {
        "tasks": {name: entry(row) for name, row in summary.tasks.items()},
        "memory_types": {name: entry(row) for name, row in summary.memory_types.items()},
        "average": entry(summary.average),
        "failures": dict(summary.failures),
        "prefix": {name: [percent(rate.value) for rate in rates] for name, rates in summary.prefix.items()},
    }
