"""The tables of one evaluation: rates, prefix completion, how rollouts ended."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from lerobot_memobench.evaluation.documents.tables import Cell, Count, Name, Numbers, Table, figure
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, Row
from lerobot_memobench.evaluation.metrics.summary import Summary
from lerobot_memobench.io import count_of

AVERAGE = "average of memory types"

HOW_TO_READ = (
    "SR is success, MSR, MUR and MCR the rates at which checkpoints of Storage, Update and Compression were satisfied "
    "at some step. Per cent, with the Wilson 95 % interval; n counts rollouts; – is not applicable."
)


# --- rates ---


def rates(summary: Summary) -> Table:
    """Return one table of all tasks, each memory type's after them, and the average."""
    rows: list[tuple[Cell, ...]] = []
    strong, rules = [], []
    for memory_type, row in summary.memory_types.items():
        if rows:
            rules.append(len(rows))
        names = _tasks_of(summary, memory_type)
        rows += [rate_row(Name(name), summary.tasks[name]) for name in names]
        strong.append(len(rows))
        rows.append(rate_row(f"{memory_type} ({count_of(len(names), 'task')})", row))
    rules.append(len(rows))
    strong.append(len(rows))
    rows.append(rate_row(AVERAGE, summary.average))
    return Table("rates", "", ("task", "n", *METRICS), tuple(rows), strong=frozenset(strong), rules=frozenset(rules))


def memory_types(summary: Summary, title: str = "Rates by memory type") -> Table:
    """Return one row per memory type, and the average."""
    rows = [rate_row(name, row) for name, row in summary.memory_types.items()]
    return Table(
        "memory-types",
        title,
        ("memory type", "n", *METRICS),
        (*rows, rate_row(AVERAGE, summary.average)),
        note=HOW_TO_READ,
        strong=frozenset({len(rows)}),
        rules=frozenset({len(rows)}),
    )


def tasks(summary: Summary) -> Table:
    """Return one row per task."""
    names = list(summary.tasks)
    types = [summary.memory_type_of[name] for name in names]
    return Table(
        "tasks",
        "Rates by task",
        ("task", "n", *METRICS),
        tuple(rate_row(Name(name), summary.tasks[name]) for name in names),
        rules=frozenset(k for k in range(1, len(types)) if types[k] != types[k - 1]),
    )


def rate_row(name: Cell, row: Row) -> tuple[Cell, ...]:
    """Return a row of a table of rates: name, n, metrics."""
    return (name, Count(row["SR"].n), *(row[metric] for metric in METRICS))


# --- prefix completion ---


def prefix(summary: Summary) -> Table:
    """Return per task how many rollouts came as far as each checkpoint, in any order and in order."""
    width = max((len(found) for found in summary.prefix.values()), default=0)
    rows = []
    for name, plain in summary.prefix.items():
        cells: list[Cell] = [
            Numbers(f"{figure(a.value)} / {figure(b.value)}")
            for a, b in zip(plain, summary.ordered_prefix[name], strict=True)
        ]
        labels = " ".join(summary.operations_of[name])
        rows.append((Name(name), labels, *cells, *[Numbers("")] * (width - len(cells))))
    return Table(
        "prefix",
        "Prefix completion, in any order / in order",
        ("task", "operations", *(f"c{k + 1}" for k in range(width))),
        tuple(rows),
        note=(
            "Rollouts in which a checkpoint and all before it were satisfied, at whatever steps / one after another, "
            "per cent."
        ),
    )


# --- failures ---


FURTHER_NOTES = {
    "wrong_order": " Wrong order: the steps of a procedure were done in another order than its prompt's.",
    "cut_off": " Cut off: the horizon is shorter than the protocol's 1,200 steps, so nobody knows what was remembered.",
    "miscount": " Miscount: the event was done too seldom or too often.",
    "wrong_place": " Wrong place: the thing was looked for where it is not.",
    "invalid_action": " Invalid action: one of another shape, or not finite, broke the rollout off.",
    "unstable_physics": " Unstable physics: MuJoCo warned of its own state, which broke the rollout off.",
}
"""Classes that not every evaluation has -> what the table says of them."""


def failures(summary: Summary) -> Table:
    """Return how rollouts ended, in all and by memory type."""
    counts: dict[str, Mapping[str, int]] = {"all": outcomes(summary, summary.tasks)}
    for memory_type in summary.memory_types:
        counts[memory_type] = outcomes(summary, _tasks_of(summary, memory_type))
    total = summary.rollouts
    rows: list[tuple[Cell, ...]] = []
    for outcome in ("success", *summary.failures):
        found = [Count(column[outcome]) for column in counts.values()]
        rows.append((outcome.replace("_", " "), *found, Rate(found[0] / total, total)))
    return Table(
        "failures",
        "Outcomes of rollouts",
        ("outcome", "rollouts", *list(counts)[1:], "of all"),
        tuple(rows),
        note=(
            "A failed rollout is named after the first checkpoint that was never satisfied: Storage, Update (stale "
            "memory) or Compression; reference drift where another answer than the prompt's took the place; execution "
            "failure where all checkpoints were satisfied."
            + "".join(FURTHER_NOTES.get(name, "") for name in summary.failures)
        ),
        rules=frozenset({1}),
    )


def outcomes(summary: Summary, names: Iterable[str]) -> dict[str, int]:
    """Return how the rollouts of some tasks ended: success, then every class of failure -> rollouts."""
    names = list(names)
    found = {failure: sum(summary.failures_of[name].get(failure, 0) for name in names) for failure in summary.failures}
    return {"success": sum(summary.tasks[name]["SR"].n for name in names) - sum(found.values()), **found}


def _tasks_of(summary: Summary, memory_type: str) -> list[str]:
    return [name for name, its_type in summary.memory_type_of.items() if its_type == memory_type]
