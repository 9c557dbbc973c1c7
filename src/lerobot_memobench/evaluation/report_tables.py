"""Tables, sections and sentences of a report: of one evaluation and of several."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lerobot_memobench.evaluation.metrics import MEMORY_TYPE, SUITE, Rate, Row, Summary, percent, policy_inputs
from lerobot_memobench.evaluation.records import Run, unlike
from lerobot_memobench.evaluation.tables import (
    Cell,
    Name,
    Numbers,
    PrefixRates,
    Section,
    Table,
    best_in_columns,
    figure,
    with_ids,
)
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.catalogue import GROUPS
from lerobot_memobench.tasks.task import MEMORY_TYPES


def inputs_sentence(words: str) -> str:
    """Return a policy's inputs, of `metrics.policy_inputs`, as a sentence."""
    return f"Policy inputs: {words}."


def pooled_sentence(summary: Summary) -> str:
    """Return the rates over all checkpoint records; no intervals, since records of one rollout are not independent."""
    parts = [
        f"{metric} {figure(rate.value)} ({count_of(rate.n, 'record')})"
        for metric, rate in summary.pooled.items()
        if metric != "SR" and rate.value is not None
    ]
    sentence, overall = f"SR {figure(summary.pooled['SR'].value)}", summary.pooled_checkpoints
    if overall.n:
        records = count_of(overall.n, "record")
        sentence += f", checkpoints satisfied {figure(overall.value)} ({records}): {', '.join(parts)}"
    return f"Pooled over all rollouts of all tasks: {sentence}."


def failure_line(summary: Summary) -> str:
    """Return the failures in one line, for under a table."""
    failed = {name: count for name, count in summary.failures.items() if count}
    if not failed:
        return "no failed rollouts"
    return "failed rollouts: " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failed.items())


# --- tables of one evaluation ---

AVERAGE = f"average of {MEMORY_TYPE}s"

HOW_TO_READ = {
    MEMORY_TYPE: "SR is success, MSR, MUR and MCR the rates at which checkpoints of Storage, Update and Compression "
    "were satisfied at some step. Per cent, with the Wilson 95 % interval; n counts rollouts; – is not applicable.",
    SUITE: "SR is success, per cent, with the Wilson 95 % interval; n counts rollouts.",
}
"""`Summary.grouping` -> note under a table of rates."""


def rates_table(summary: Summary) -> Table:
    """Return one table of all tasks, each memory type's or suite's rates after them, and the average."""
    rows: list[tuple[Cell, ...]] = []
    strong, rules = set(), set()
    for group, row in {**summary.memory_types, **summary.means}.items():
        rules.add(len(rows))
        names = _tasks_of(summary, group)
        rows += [rate_row(Name(name), summary.tasks[name]) for name in names]
        strong.add(len(rows))
        rows.append(rate_row(f"{group} ({count_of(len(names), 'task')})" if names else group, row))
    header = ("task", "n", *summary.average)
    return with_ids(Table("rates", "", header, rows, strong=strong, rules=rules - {0}))


def memory_types_table(summary: Summary) -> Table:
    """Return one row per memory type or suite, and the average."""
    rows = [rate_row(name, row) for name, row in (summary.memory_types | summary.means).items()]
    last = {len(summary.memory_types)}
    return Table(
        "memory-types",
        f"Rates by {summary.grouping}",
        (summary.grouping, "n", *summary.average),
        rows,
        note=HOW_TO_READ[summary.grouping],
        strong=last,
        rules=last,
    )


def tasks_table(summary: Summary) -> Table:
    """Return one row per task."""
    names = list(summary.tasks)
    types = [summary.memory_type_of[name] for name in names]
    rows = [rate_row(Name(name), summary.tasks[name]) for name in names]
    rules = [k for k in range(1, len(types)) if types[k] != types[k - 1]]
    return with_ids(Table("tasks", "Rates by task", ("task", "n", *summary.average), rows, rules=rules))


def rate_row(name: Cell, row: Row) -> tuple[Cell, ...]:
    """Return a row of a table of rates: name, n, metrics."""
    return (name, row["SR"].n, *row.values())


def prefix_table(summary: Summary) -> Table:
    """Return per task how many rollouts came as far as each checkpoint, in any order and in order."""
    width = max(map(len, summary.prefix.values()), default=0)
    rows = []
    for name, plain in summary.prefix.items():
        cells: list[Cell] = [PrefixRates(*pair) for pair in zip(plain, summary.ordered_prefix[name], strict=True)]
        labels = " ".join(summary.operations_of[name])
        rows.append((Name(name), labels, *cells, *[Numbers("")] * (width - len(cells))))
    return Table(
        "prefix",
        "Prefix completion, in any order / in order",
        ("task", "operations", *(f"c{k + 1}" for k in range(width))),
        rows,
        note="Rollouts in which a checkpoint and all before it were satisfied, at whatever steps / one after another, "
        "per cent.",
    )


FAILURES_NOTES = {
    MEMORY_TYPE: "A failed rollout is named after the first checkpoint that was never satisfied: Storage, Update "
    "(stale memory) or Compression; reference drift where another answer than the prompt's took the place; execution "
    "failure where all checkpoints were satisfied.",
    SUITE: "Execution failure: the goal was not reached within the step limit of the suite.",
}
FURTHER_NOTES = {
    "wrong_order": " Wrong order: steps or events were done in another order than asked for.",
    "cut_off": " Cut off: the goal was not reached, and the horizon is shorter than the protocol's.",
    "miscount": " Miscount: the event was done too seldom or too often.",
    "wrong_place": " Wrong place: the thing was looked for where it is not.",
    "hand": " Hand: events, order and place were right as far as they had to be remembered; the motion failed.",
    "invalid_action": " Invalid action: one of another shape, or not finite, broke the rollout off.",
    "unstable_physics": " Unstable physics: MuJoCo warned of its own state, which broke the rollout off.",
}
"""Classes that not every evaluation has -> their note under the table."""


def failures_table(summary: Summary) -> Table:
    """Return how rollouts ended, in all and by memory type."""
    counts: dict[str, Mapping[str, int]] = {"all": outcomes(summary, summary.tasks)}
    for memory_type in summary.memory_types if len(summary.memory_types) > 1 else ():
        counts[memory_type] = outcomes(summary, _tasks_of(summary, memory_type))
    total = summary.rollouts
    rows: list[tuple[Cell, ...]] = []
    for outcome in ("success", *summary.failures):
        numbers = [column[outcome] for column in counts.values()]
        rows.append((outcome.replace("_", " "), *numbers, Rate(numbers[0] / total, total)))
    note = FAILURES_NOTES[summary.grouping] + "".join(FURTHER_NOTES.get(name, "") for name in summary.failures)
    return Table(
        "failures",
        "Outcomes of rollouts",
        ("outcome", "rollouts", *list(counts)[1:], "of all"),
        rows,
        note=note,
        rules={1},
    )


def outcomes(summary: Summary, names: Iterable[str]) -> dict[str, int]:
    """Return how the rollouts of some tasks ended: success, then every class of failure -> rollouts."""
    names = list(names)
    failed = {failure: sum(summary.failures_of[name].get(failure, 0) for name in names) for failure in summary.failures}
    return {"success": sum(summary.tasks[name]["SR"].n for name in names) - sum(failed.values()), **failed}


def _tasks_of(summary: Summary, memory_type: str) -> list[str]:
    return [name for name, its_type in summary.memory_type_of.items() if its_type == memory_type]


# --- several evaluations, in the layout of the paper's main table: every memory type's rates in one row ---

PAPER_COLUMNS = (*MEMORY_TYPES, "average")
"""Groups of columns of the paper's main table."""
LEADING = ("evaluation", "inputs", "k")
"""Columns before the rates."""
NOTE = "inputs: of the policy; k: the replan interval."


def overview(runs: Sequence[Run]) -> Table:
    """Return one row per evaluation; the note names the settings in which they differ."""
    columns = columns_of(runs)
    rows = [run_row(run, columns) for run in runs]
    note = " ".join([NOTE, *unlike(runs)])
    wide = wide_columns(LEADING, columns, runs[0].summary.average)
    return Table("overview", "Evaluations", rows=rows, note=note, best=best_in_columns(rows), **wide)


def run_row(run: Run, columns: Sequence[str] = PAPER_COLUMNS) -> tuple[Cell, ...]:
    """Return the row of an evaluation: its cells under `LEADING`, and `all_rates`."""
    return (run.name, run.summary.inputs, run.replan_steps, *all_rates(run.summary, columns))


def all_rates(summary: Summary, columns: Sequence[str]) -> list[Rate]:
    """Return the metrics of memory types or suites and of the average, in the order of ``columns``."""
    absent = dict.fromkeys(summary.average, Rate(None, 0))
    rates = summary.memory_types | dict.fromkeys(PAPER_COLUMNS[-1:] * len(summary.means), summary.average)
    return [rate for name in columns for rate in rates.get(name, absent).values()]


def columns_of(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the groups of columns of a wide table: the paper's, or the suites of LIBERO and their average."""
    if runs[0].summary.grouping == MEMORY_TYPE:
        return PAPER_COLUMNS
    suites = {name for run in runs for name in run.summary.memory_types}
    return tuple(name for name in GROUPS if name in suites) + PAPER_COLUMNS[-1:] * (len(suites) > 1)


def wide_columns(leading: tuple[str, ...], columns: Sequence[str], metrics: Iterable[str]) -> dict[str, Any]:
    """Return header and groups of a table whose rows are leading cells, then ``metrics`` under each of ``columns``."""
    metrics = tuple(metrics)
    groups = (*(("", 1) for _ in leading), *((name, len(metrics)) for name in columns))
    return {"header": (*leading, *metrics * len(columns)), "groups": groups, "intervals": False}


def joined_table(runs: Sequence[Run]) -> Table:
    """Return one row per task, memory type and average, with the rates of all evaluations next to each other."""
    metrics = tuple(runs[0].summary.average)
    absent: Row = dict.fromkeys(metrics, Rate(None, 0))
    summaries = [run.summary for run in runs]
    rows: list[tuple[Cell, ...]] = []
    strong, rules = set(), set()

    def add(name: str, sources: Iterable[Mapping[str, Row]]) -> None:
        each = [source.get(name, absent) for source in sources]
        rows.append((name, *(row[metric] for metric in metrics for row in each)))

    for memory_type in GROUPS:
        names = dict.fromkeys(name for each in summaries for name in _tasks_of(each, memory_type))
        for name in names:
            add(Name(name), (each.tasks for each in summaries))
        if names:
            strong.add(len(rows))
            add(memory_type, (each.memory_types for each in summaries))
            rules.add(len(rows))
    for name in dict.fromkeys(name for each in summaries for name in each.means):
        strong.add(len(rows))
        add(name, (each.means for each in summaries))
    table = Table(
        "joined",
        "Rates by task",
        ("task", *(run.name for _ in metrics for run in runs)),
        rows,
        note="Per cent; – is not applicable. Intervals: in CSV, JSON and the report of each evaluation alone.",
        groups=(("", 1), *((metric, len(runs)) for metric in metrics)),
        strong=strong,
        rules=rules,
        intervals=False,
    )
    return with_ids(table)


# --- one method at several replan intervals ---


def sweep(method: str, runs: Sequence[Run]) -> Section:
    """Return the tables of one method at several replan intervals, and which interval is best for what."""
    averages = [(run.replan_steps, *rate_row(None, run.summary.average)[1:]) for run in runs]
    columns = columns_of(runs)
    types = [(run.replan_steps, *all_rates(run.summary, columns)) for run in runs]
    first = runs[0].summary
    inputs = inputs_sentence(policy_inputs([record for run in runs for record in run.records]))
    slug = "-".join("".join(c if c.isalnum() and c.isascii() else " " for c in method).split()) or "policy"
    tables = (
        Table(
            f"replan-{slug}",
            f"Average by replan interval: {method}",
            ("replan interval", "n", *first.average),
            averages,
            note=f"{HOW_TO_READ[first.grouping]} {inputs}",
            best=best_in_columns(averages),
        ),
        Table(
            f"replan-types-{slug}",
            f"{first.grouping.capitalize()}s by replan interval: {method}",
            rows=types,
            note=inputs,
            best=best_in_columns(types),
            **wide_columns(("replan interval",), columns, first.average),
        ),
    )
    best = [
        f"{metric} {figure(rate.value)} at {' and '.join(map(str, steps))}"
        for metric in first.average
        for steps, rate in [best_interval(runs, metric)]
        if rate is not None
    ]
    notes = []
    if len({frozenset(run.summary.tasks) for run in runs}) > 1:
        notes.append("the intervals were not evaluated on the same tasks; their averages do not compare")
    return Section(f"Replan sweep: {method}", tables, [f"Best replan interval by average: {', '.join(best)}."], notes)


def best_interval(runs: Sequence[Run], metric: str) -> tuple[list[int], Rate | None]:
    """Return the replan intervals with the highest average of a metric as printed, and that average."""
    values = [percent(run.summary.average[metric].value) for run in runs]
    highest = max((value for value in values if value is not None), default=None)
    if highest is None:
        return [], None
    best = [run for value, run in zip(values, runs, strict=True) if value == highest]
    return [run.replan_steps for run in best if run.replan_steps is not None], best[0].summary.average[metric]
