"""Every figure of a set of rollouts, and what of it stands in ``report.json``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.failures import failure_counts
from lerobot_memobench.evaluation.metrics.rates import (
    METRICS,
    Rate,
    Row,
    checkpoint_rate,
    column_rates,
    mean_row,
    percent,
    pooled_row,
    task_row,
)
from lerobot_memobench.evaluation.metrics.rollouts import (
    Record,
    by_task,
    completed_in_order,
    operations,
    policy_inputs,
    prefix,
    satisfied,
)
from lerobot_memobench.tasks.task import MEMORY_TYPES, OPERATIONS


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
        inputs: of the policy, in words.
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
    inputs: str

    @property
    def rollouts(self) -> int:
        """How many rollouts there are."""
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
        pooled_checkpoints=checkpoint_rate(records, "".join(OPERATIONS)),
        prefix={name: column_rates([prefix(satisfied(r)) for r in group]) for name, group in groups.items()},
        ordered_prefix={
            name: column_rates([prefix(completed_in_order(r)) for r in group]) for name, group in groups.items()
        },
        failures=failure_counts(records),
        failures_of={name: failure_counts(group) for name, group in groups.items()},
        memory_type_of=memory_type_of,
        operations_of={name: operations(group[0]) for name, group in groups.items()},
        inputs=policy_inputs(records),
    )


def report(summary: Summary) -> dict[str, Any]:
    """Return the content of ``report.json``: percentages with one decimal, null where not applicable."""
    return {
        "tasks": {name: _percentages(row) for name, row in summary.tasks.items()},
        "memory_types": {name: _percentages(row) for name, row in summary.memory_types.items()},
        "average": _percentages(summary.average),
        "failures": dict(summary.failures),
        "prefix": {name: [percent(rate.value) for rate in rates] for name, rates in summary.prefix.items()},
        "inputs": summary.inputs,
    }


def _percentages(row: Row) -> dict[str, Any]:
    return {"n": row["SR"].n, **{metric: percent(row[metric].value) for metric in METRICS}}
