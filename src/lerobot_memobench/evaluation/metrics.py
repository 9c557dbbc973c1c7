"""SR, MSR, MUR and MCR of rollouts with their intervals, prefix completion, and classes of failure.

A rollout is one line of the episode log. Rates are fractions in [0, 1]; `report_values` turns them into percentages
with one decimal. None means not applicable: a task without checkpoints of an operation has no rate for it and
leaves that average.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final, NamedTuple

from lerobot_memobench.errors import MemobenchError, count_of, nearest
from lerobot_memobench.tasks.assessment import FAILURES, FAULTS, REFINED_FAILURES, classify
from lerobot_memobench.tasks.catalogue import GROUPS, libero_id, suite_of
from lerobot_memobench.tasks.task import LIBERO_SUITES, MEMORY_TYPES, PUBLISHED, STRICT_FAILURES

Record = Mapping[str, Any]
"""A rollout: one line of the episode log."""


# --- checkpoints of rollouts ---


def operations(record: Record) -> str:
    """Return the labels of a rollout's checkpoints, such as "SUU"."""
    return "".join(checkpoint["operation"] for checkpoint in record["checkpoints"])


def satisfied(record: Record) -> list[bool]:
    """Return per checkpoint whether its predicate held at some step of the execution, (K,)."""
    return [checkpoint["first_step"] is not None for checkpoint in record["checkpoints"]]


def completed_in_order(record: Record) -> list[bool]:
    """Return per checkpoint whether it held while all earlier ones were complete, (K,)."""
    return [checkpoint.get("ordered_step") is not None for checkpoint in record["checkpoints"]]


def prefix(values: Sequence[bool]) -> list[bool]:
    """Return per checkpoint whether it and all earlier ones are true, (K,)."""
    return [all(values[: k + 1]) for k in range(len(values))]


def by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    """Group records by task, in the order of memory types and names, or of LIBERO's suites and ids.

    Raises:
        MemobenchError: rollouts of one task differ in its memory type or operations.
    """
    grouped: dict[str, list[Record]] = {}
    for record in records:
        grouped.setdefault(record["task"], []).append(record)
    for name, group in grouped.items():
        for field, values in (
            ("memory_type", {record["memory_type"] for record in group}),
            ("operations", {operations(record) for record in group}),
        ):
            if len(values) > 1:
                raise MemobenchError(
                    f"rollouts of {name!r} disagree on their {field} ({', '.join(sorted(values))}); "
                    "report logs of different versions of a task separately"
                )
        if group[0]["memory_type"] not in GROUPS:
            raise MemobenchError(
                f"rollouts of {name!r} have the memory type {group[0]['memory_type']!r}; expected one of "
                + ", ".join(MEMORY_TYPES)
            )
    order = {memory_type: k for k, memory_type in enumerate(GROUPS)}
    ids = {name: libero_id(name) or 0 for name in grouped}
    return dict(sorted(grouped.items(), key=lambda item: (order[item[1][0]["memory_type"]], ids[item[0]], item[0])))


# --- notes on rollouts ---

NOT_RECORDED = "not recorded"
"""Inputs of a policy whose log does not record them."""


def inputs_phrase(records: Iterable[Record]) -> str:
    """Return the inputs that rollouts record; they differ only between evaluations."""
    return "; ".join(sorted({str(record.get("inputs") or NOT_RECORDED) for record in records})) or NOT_RECORDED


def varies(record: Record) -> bool:
    """Return whether the scene of a rollout is run with several variants."""
    return (record.get("variants") or 1) > 1


def notes_on(records: Sequence[Record]) -> list[str]:
    """Return notes for a reader of the rollouts' rates, a sentence each."""
    notes = faults(records)
    for task, group in by_task(record for record in records if record.get("prompt_shown") is False).items():
        notes.append(
            f"{task}: the demonstration prompt did not show its scene in {count_of(len(group), 'rollout')}, the first "
            f"in episode {group[0]['episode']}; no memory of it can solve the task"
        )
    notes += unsettled(records)
    if missing := stand_ins_of(records):
        notes.append(
            f"this package's objects replaced the missing scans {', '.join(missing)}: figures with and without them do "
            "not compare"
        )
    if any(record.get("referent") == "fixed" and suite_of(record["task"]) == PUBLISHED for record in records):
        notes.append(
            "a routine without a memory solves published goals with fixed referents; claims of memory need suite=strict"
        )
    return notes


def faults(records: Iterable[Record]) -> list[str]:
    """Return a sentence for each task with rollouts that were broken off, and so failed."""
    notes = []
    for task, group in by_task(record for record in records if record.get("fault")).items():
        were, count = ("was", "counts") if len(group) == 1 else ("were", "count")
        notes.append(
            f"{task}: {count_of(len(group), 'rollout')} {were} broken off and {count} as failed, the first in episode "
            f"{group[0]['episode']}: {group[0]['fault']}"
        )
    return notes


def unsettled(records: Iterable[Record]) -> list[str]:
    """Return a sentence on the scenes in which an object was thrown, or still moved, before the first action."""
    counts = []
    for task, group in by_task(records).items():
        scenes = {record.get("seed"): record.get("settled", True) for record in group}
        if thrown := sum(not settled for settled in scenes.values()):
            counts.append(f"{thrown} of {count_of(len(scenes), 'scene')} of {task}")
    reference = "results/unsettled_scenes.md lists those of the paper's seeds"
    note = f"an object is thrown or still moves before the first action in {', '.join(counts)}; {reference}"
    return [note] if counts else []


def stand_ins_of(records: Iterable[Record]) -> list[str]:
    """Return the classes whose missing scans this package's objects replaced in any of the rollouts."""
    return sorted({name for record in records for name in record.get("stand_ins", ())})


# --- rates ---

Z95 = 1.959963984540054
"""Quantile of the normal distribution for two-sided 95 %."""


@dataclass(frozen=True)
class Rate:
    """A rate and how many rollouts it rests on.

    Attributes:
        value: fraction in [0, 1]; None when not applicable.
        n: number of trials: rollouts, because checkpoints of one rollout are dependent; checkpoint records in pooled
            rates.
        effective: of a mean of rates, the number of rollouts of a plain rate with the same standard error; of rollouts
            of each scene with each variant, the number of scenes; None where it is n.
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
        """Wilson's 95 % interval; None where the rate does not apply, or rests on no rollouts, such as the paper's."""
        return None if self.value is None or not self.trials else wilson(self.value, self.trials)


Row = dict[str, Rate]
"""Metric -> rate. LIBERO's suites, which have no checkpoints, have SR alone."""


def wilson(rate: float, n: float) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a rate over ``n`` trials, within [0, 1]."""
    # Not SciPy's: every evaluation ends with a report, and importing SciPy's statistics takes longer than the report.
    if n < 1 or not 0.0 <= rate <= 1.0:
        raise MemobenchError(f"a Wilson interval needs a rate in [0, 1] over at least one trial, got {rate} over {n}")
    z = Z95
    centre = rate + z * z / (2 * n)
    spread = z * math.sqrt(rate * (1 - rate) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return max(0.0, (centre - spread) / scale), min(1.0, (centre + spread) / scale)


def percent(value: float | None) -> float | None:
    """Return a fraction as a percentage with one decimal; None stays None."""
    return None if value is None else round(100.0 * value, 1)


# --- metrics ---


class Metric(NamedTuple):
    """A metric: the share of a rollout's outcomes that are true, [] where it does not apply; higher is better.

    ``title`` is a word for the axis of a figure.
    """

    title: str
    outcomes: Callable[[Record], list[bool]]


def of_operation(operation: str, record: Record) -> list[bool]:
    """Return per checkpoint of an operation whether it was satisfied."""
    return [done for label, done in zip(operations(record), satisfied(record), strict=True) if label == operation]


METRICS: dict[str, Metric] = {
    "SR": Metric("success", lambda record: [bool(record["success"])]),
    "MSR": Metric("storage", partial(of_operation, "S")),
    "MUR": Metric("update", partial(of_operation, "U")),
    "MCR": Metric("compression", partial(of_operation, "C")),
}
"""Name -> metric. Tables, JSON, comparisons and figures of reports have a column for each."""
PAPER_METRICS = ("SR", "MSR", "MUR", "MCR")  # of published tables, the board and the Hub
PROCESS_METRICS = PAPER_METRICS[1:]
"""Metrics of checkpoints, which LIBERO's suites do not have."""


# --- rates of rollouts ---


def task_row(records: Sequence[Record]) -> Row:
    """Return the metrics of one task's rollouts: the mean over rollouts of the mean over a rollout's outcomes."""
    pooled, scenes = pooled_row(records), None
    if any(map(varies, records)):
        # Rollouts of one scene depend on each other, by an unknown amount: the interval over scenes is the widest.
        scenes = len({(record["task"], record.get("seed")) for record in records})
    return {metric: Rate(rate.value, len(records) if rate.n else 0, scenes) for metric, rate in pooled.items()}


def pooled_row(records: Sequence[Record]) -> Row:
    """Return the metrics over all outcomes of all rollouts; n counts outcomes, such as checkpoint records."""
    outcomes = {
        metric: [outcome for record in records for outcome in METRICS[metric].outcomes(record)]
        for metric in _metrics(records)
    }
    return {metric: share(values) for metric, values in outcomes.items()}


def rollout_value(record: Record, metric: str) -> float | None:
    """Return a rollout's contribution to a metric: success, or the share of its operation's checkpoints satisfied."""
    return share(METRICS[metric].outcomes(record)).value


def share(values: Sequence[bool]) -> Rate:
    """Return the share of values that are true."""
    return Rate(sum(values) / len(values) if values else None, len(values))


def _metrics(records: Sequence[Record]) -> Sequence[str]:
    return ("SR",) if any(record.get("memory_type") in LIBERO_SUITES for record in records) else tuple(METRICS)


def _prefix_rates(group: Sequence[Record], reached: Callable[[Record], list[bool]]) -> list[Rate]:
    return [share(column) for column in zip(*(prefix(reached(record)) for record in group), strict=True)]


# --- means of rates ---


def mean_row(rows: Iterable[Row]) -> Row:
    """Return the mean of several rows, metric by metric, over those to which the metric applies."""
    rows = list(rows)
    return {metric: mean_rate([row[metric] for row in rows]) for metric in rows[0]}


def mean_rate(rates: Iterable[Rate]) -> Rate:
    """Return the mean of the applicable rates, each of the same weight whatever its n.

    A mean of m rates over n₁ … n_m rollouts has the variance p(1 − p) · Σ 1/(m² n_i) where they share p, which is that
    of a plain rate over m² / Σ 1/n_i rollouts.
    """
    applicable = [rate for rate in rates if rate.value is not None]
    if not applicable:
        return Rate(None, 0)
    count, n = len(applicable), sum(rate.n for rate in applicable)
    mean = sum(rate.value for rate in applicable if rate.value is not None) / count
    trials = [rate.trials for rate in applicable]
    if 0 in trials:  # rates without rollouts, such as the paper's
        return Rate(mean, n)
    effective = count * count / sum(1 / number for number in trials)
    return Rate(mean, n, None if math.isclose(effective, n) else effective)


# --- failures; the rule itself is `tasks.assessment` ---

_ALL = (*FAILURES, *REFINED_FAILURES, *STRICT_FAILURES, *FAULTS)


def failure_of(record: Record) -> str | None:
    """Return the failure class of a logged rollout, None for a success; raise for an unknown or contradicting class."""
    logged = record.get("failure")
    if record["success"]:
        if logged is not None:
            raise MemobenchError(
                f"a rollout of {record['task']!r} is a success and has the failure class {logged!r}; expected no "
                "class: the log was changed or damaged, evaluate again"
            )
        return None
    if logged is None:  # a log of another tool: the checkpoints give the class, but never a drift
        checkpoints = record["checkpoints"]
        return classify([c["operation"] for c in checkpoints], [c["first_step"] for c in checkpoints], False)
    if logged not in _ALL:
        raise MemobenchError(
            f"a rollout of {record['task']!r} has the unknown failure class {logged!r}, " + nearest(str(logged), _ALL)
        )
    return str(logged)


def failure_counts(records: Iterable[Record]) -> dict[str, int]:
    """Return class -> number of failed rollouts, in the report's order."""
    records = list(records)
    # Reports list each of the paper's classes, but those of LIBERO's suites, which lack checkpoints, only those found.
    counts, always = Counter(map(failure_of, records)), FAILURES if len(_metrics(records)) > 1 else ()
    return {name: counts[name] for name in _ALL if name in always or counts[name]}


# --- summary ---


MEMORY_TYPE: Final = "memory type"
SUITE: Final = "suite"
"""Values of `Summary.grouping`."""


@dataclass(frozen=True)
class TaskSummary:
    """All rates of one task's rollouts.

    Attributes:
        operations: labels of the checkpoints, such as "SUU".
        prefix, ordered_prefix: per checkpoint the rate of rollouts in which it and all earlier ones were satisfied, in
            any order and in order.
    """

    memory_type: str
    operations: str
    rates: Row
    prefix: list[Rate]
    ordered_prefix: list[Rate]
    failures: dict[str, int]


@dataclass(frozen=True)
class Summary:
    """All rates of a set of rollouts.

    Attributes:
        memory_types: name -> metrics, each the mean over its applicable tasks; a suite of LIBERO is one of them.
        average: mean over the applicable memory types.
        pooled: MSR, MUR, MCR over all checkpoint records of the operation, of all tasks; n counts records.
        pooled_checkpoints: the same over all operations.
        inputs: of the policy, in words.
    """

    tasks: dict[str, TaskSummary]
    memory_types: dict[str, Row]
    average: Row
    pooled: Row
    pooled_checkpoints: Rate
    failures: dict[str, int]
    inputs: str

    @property
    def grouping(self) -> str:
        """The groups of tasks: memory types, or suites of LIBERO, whose tasks have no checkpoints."""
        return SUITE if {*self.memory_types} & {*LIBERO_SUITES} else MEMORY_TYPE

    @property
    def means(self) -> dict[str, Row]:
        """The average under its name; {} for a single suite of LIBERO, which it would repeat."""
        alone = self.grouping == SUITE and len(self.memory_types) == 1
        return {} if alone else {f"average of {self.grouping}s": self.average}

    @property
    def rollouts(self) -> int:
        """How many rollouts there are."""
        return self.pooled["SR"].n

    def tasks_of(self, memory_type: str) -> list[str]:
        """Return the names of a memory type's tasks, or of a suite's."""
        return [name for name, task in self.tasks.items() if task.memory_type == memory_type]


def summary_of(records: Iterable[Record]) -> Summary:
    """Compute all rates of a set of rollouts."""
    records = list(records)
    if not records:
        raise MemobenchError("there are no rollouts to report; run an evaluation first")
    tasks = {
        name: TaskSummary(
            str(group[0]["memory_type"]),
            operations(group[0]),
            task_row(group),
            _prefix_rates(group, satisfied),
            _prefix_rates(group, completed_in_order),
            failure_counts(group),
        )
        for name, group in by_task(records).items()
    }
    memory_types = {
        memory_type: mean_row(rows)
        for memory_type in GROUPS
        if (rows := [task.rates for task in tasks.values() if task.memory_type == memory_type])
    }
    return Summary(
        tasks=tasks,
        memory_types=memory_types,
        average=mean_row(memory_types.values()),
        pooled=pooled_row(records),
        pooled_checkpoints=share([done for record in records for done in satisfied(record)]),
        failures=failure_counts(records),
        inputs=inputs_phrase(records),
    )


def report_values(summary: Summary) -> dict[str, Any]:
    """Return the content of ``report.json``: percentages with one decimal, null where not applicable."""
    return {
        "tasks": {name: _percentages(task.rates) for name, task in summary.tasks.items()},
        "memory_types": {name: _percentages(row) for name, row in summary.memory_types.items()},
        "average": _percentages(summary.average),
        "failures": dict(summary.failures),
        "prefix": {name: [percent(rate.value) for rate in task.prefix] for name, task in summary.tasks.items()},
        "inputs": summary.inputs,
    }


def _percentages(row: Row) -> dict[str, Any]:
    return {"n": row["SR"].n, **{metric: percent(rate.value) for metric, rate in row.items()}}
