"""Tables, sections and sentences of a report: of one evaluation, of several, and with the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from lerobot_memobench.envs.episode_log import with_omitted
from lerobot_memobench.envs.settings import PICTURES
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import MEMORY_TYPE, METRICS, SUITE, Rate, Row, Summary, percent, policy_inputs
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
from lerobot_memobench.paper import failure_taxonomy, published_rows
from lerobot_memobench.protocol import BY_PAPER, EVALUATION_SEED, HORIZON
from lerobot_memobench.sim.scene_hash import LIBERO, WORLD
from lerobot_memobench.tasks.catalogue import GROUPS
from lerobot_memobench.tasks.task import MEMORY_TYPES, PUBLISHED


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
    rows = [(*_leading(run), *all_rates(run.summary, columns)) for run in runs]
    note = " ".join([NOTE, *unlike(runs)])
    wide = _wide(LEADING, columns, runs[0].summary.average)
    return Table("overview", "Evaluations", rows=rows, note=note, best=best_in_columns(rows), **wide)


def _leading(run: Run) -> tuple[Cell, ...]:
    return run.name, run.summary.inputs, run.replan_steps


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


def _wide(leading: tuple[str, ...], columns: Sequence[str], metrics: Iterable[str]) -> dict[str, Any]:
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
            **_wide(("replan interval",), columns, first.average),
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


# --- with the paper's figures ---

PAPER_PROTOCOL = {
    **{WORLD: LIBERO, "protocol": BY_PAPER, "referent": "fixed", "demonstration_prompt": True, "horizon": HORIZON},
    **{"seed_base": EVALUATION_SEED, **PICTURES},
}
PAPER_INPUTS = "pixels"
PAPER_TASKS, PAPER_EPISODES = 30, 50

TABLES = (
    ("paper-main", "With the paper's main results", ("main",)),
    ("paper-alignment", "With the paper's memory alignment results", ("alignment",)),
    ("paper-reference", "With the paper's oracle memory and MemER", ("oracle", "memer")),
)
"""Key, title, and which of the paper's tables it holds."""


def check_paper_rows(runs: Sequence[Run], paper: bool) -> None:
    """Refuse to report the paper's figures (``paper``) with those of tasks that it did not publish.

    Raises:
        MemobenchError: naming the first such evaluation.
    """
    other = next((run for run in runs if run.protocol.get("suite", PUBLISHED) != PUBLISHED), None)
    if paper and other is not None:
        raise MemobenchError(
            f"{other.folder} is an evaluation of the {other.protocol['suite']} suite, the paper's figures are of the "
            "published one; leave out --with paper"
        )


def paper_section(runs: Sequence[Run]) -> Section:
    """Return the paper's tables of rates with these evaluations in the first rows, and departures from its protocol."""
    tables = [_paper_table(runs, *each) for each in TABLES]
    notes = [f"{run.name} departs from the paper's protocol: {', '.join(d)}" for run in runs if (d := departures(run))]
    return Section("With the paper's figures", [*tables, paper_failures()], notes=notes)


def extent(run: Run) -> str:
    """Return how many tasks and rollouts an evaluation is of, "" where it is as many as the paper's."""
    summary = run.summary
    if len(summary.tasks) == PAPER_TASKS and {row["SR"].n for row in summary.tasks.values()} == {PAPER_EPISODES}:
        return ""
    return f"{len(summary.tasks)} of {PAPER_TASKS} tasks, {count_of(summary.rollouts, 'rollout')}"


def _paper_table(runs: Sequence[Run], key: str, title: str, sources: Sequence[str]) -> Table:
    """Return a table of the paper's, ours on top, named with their extent: the paper ran 1,500 rollouts."""
    published = published_rows(*sources)
    rows: list[tuple[Cell, ...]] = []
    for run in runs:
        name, *leading = _leading(run)
        rows.append((f"{name} ({size})" if (size := extent(run)) else name, *leading))
        rows[-1] += tuple(all_rates(run.summary, PAPER_COLUMNS))
    for row in published:
        types = [*(row.memory_types[name] for name in MEMORY_TYPES), row.average]
        rates = [published_rate(figures[metric]) for figures in types for metric in METRICS]
        rows.append((f"paper: {row.label}", PAPER_INPUTS, row.replan_steps, *rates))
    steps = [row.replan_steps for row in published]
    rules = {len(runs), *(len(runs) + k for k in range(1, len(steps)) if steps[k] != steps[k - 1])}
    wide = _wide(LEADING, PAPER_COLUMNS, METRICS)
    return Table(key, title, rows=rows, note=NOTE, strong=range(len(runs)), rules=rules, **wide)


def published_rate(value: float | None) -> Rate:
    """Return a published percentage as a rate without interval: the paper gives none."""
    return Rate(None if value is None else value / 100, 0)


def paper_failures() -> Table:
    """Return how the paper's rollouts of its temporal task ended."""
    counts = failure_taxonomy()
    total = counts.pop("rollouts")
    rows = [(name.replace("_", " "), count, Rate(count / total, total)) for name, count in counts.items()]
    return Table(
        "paper-failures",
        f"The paper's outcomes of {total} rollouts of a temporal task with the checkpoints S, U, U",
        ("outcome", "rollouts", "of all"),
        rows,
    )


def departures(run: Run) -> list[str]:
    """Return a phrase for each departure of an evaluation from the paper's protocol."""
    phrases = []
    if len(run.summary.tasks) != PAPER_TASKS:
        phrases.append(f"{len(run.summary.tasks)} of {PAPER_TASKS} tasks")
    counts = {row["SR"].n for row in run.summary.tasks.values()}
    if counts != {PAPER_EPISODES}:
        low, high = min(counts), max(counts)
        phrases.append(f"{low if low == high else f'{low} to {high}'} episodes of each instead of {PAPER_EPISODES}")
    known = with_omitted(run.protocol)
    return phrases + [
        f"{key.replace('_', ' ')} {known[key]} instead of {value}"
        for key, value in PAPER_PROTOCOL.items()
        if key in known and known[key] != value
    ]
