"""Tables, sections and sentences of a report: of one evaluation, of several, and with the paper's figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

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
from lerobot_memobench.paper import PublishedRow, failure_taxonomy, published_rows
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
    overall = summary.pooled_checkpoints
    if not overall.n:
        return f"Pooled over all rollouts of all tasks: SR {figure(summary.pooled['SR'].value)}."
    return (
        f"Pooled over all rollouts of all tasks: SR {figure(summary.pooled['SR'].value)}, "
        f"checkpoints satisfied {figure(overall.value)} ({count_of(overall.n, 'record')}): {', '.join(parts)}."
    )


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
    strong, rules = [], []
    for memory_type, row in summary.memory_types.items():
        if rows:
            rules.append(len(rows))
        names = _tasks_of(summary, memory_type)
        rows += [rate_row(Name(name), summary.tasks[name]) for name in names]
        strong.append(len(rows))
        rows.append(rate_row(f"{memory_type} ({count_of(len(names), 'task')})", row))
    for name, row in summary.means.items():
        rules.append(len(rows))
        strong.append(len(rows))
        rows.append(rate_row(name, row))
    header = ("task", "n", *summary.average)
    return with_ids(Table("rates", "", header, tuple(rows), strong=frozenset(strong), rules=frozenset(rules)))


def memory_types_table(summary: Summary) -> Table:
    """Return one row per memory type or suite, and the average."""
    rows = [rate_row(name, row) for name, row in (summary.memory_types | summary.means).items()]
    last = frozenset({len(summary.memory_types)})
    return Table(
        "memory-types",
        f"Rates by {summary.grouping}",
        (summary.grouping, "n", *summary.average),
        tuple(rows),
        note=HOW_TO_READ[summary.grouping],
        strong=last,
        rules=last,
    )


def tasks_table(summary: Summary) -> Table:
    """Return one row per task."""
    names = list(summary.tasks)
    types = [summary.memory_type_of[name] for name in names]
    rows = tuple(rate_row(Name(name), summary.tasks[name]) for name in names)
    rules = frozenset(k for k in range(1, len(types)) if types[k] != types[k - 1])
    return with_ids(Table("tasks", "Rates by task", ("task", "n", *summary.average), rows, rules=rules))


def rate_row(name: Cell, row: Row) -> tuple[Cell, ...]:
    """Return a row of a table of rates: name, n, metrics."""
    return (name, row["SR"].n, *row.values())


def prefix_table(summary: Summary) -> Table:
    """Return per task how many rollouts came as far as each checkpoint, in any order and in order."""
    width = max((len(found) for found in summary.prefix.values()), default=0)
    rows = []
    for name, plain in summary.prefix.items():
        cells: list[Cell] = [PrefixRates(*pair) for pair in zip(plain, summary.ordered_prefix[name], strict=True)]
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
        found = [column[outcome] for column in counts.values()]
        rows.append((outcome.replace("_", " "), *found, Rate(found[0] / total, total)))
    note = FAILURES_NOTES[summary.grouping] + "".join(FURTHER_NOTES.get(name, "") for name in summary.failures)
    return Table(
        "failures",
        "Outcomes of rollouts",
        ("outcome", "rollouts", *list(counts)[1:], "of all"),
        tuple(rows),
        note=note,
        rules=frozenset({1}),
    )


def outcomes(summary: Summary, names: Iterable[str]) -> dict[str, int]:
    """Return how the rollouts of some tasks ended: success, then every class of failure -> rollouts."""
    names = list(names)
    found = {failure: sum(summary.failures_of[name].get(failure, 0) for name in names) for failure in summary.failures}
    return {"success": sum(summary.tasks[name]["SR"].n for name in names) - sum(found.values()), **found}


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
    rows = tuple(run_row(run, columns) for run in runs)
    note, first = " ".join([NOTE, *unlike(runs)]), runs[0].summary
    return wide_table(
        "overview", "Evaluations", rows, note=note, best=best_in_columns(rows), columns=columns, metrics=first.average
    )


def run_row(run: Run, columns: Sequence[str] = PAPER_COLUMNS) -> tuple[Cell, ...]:
    """Return the row of an evaluation."""
    return (run.name, run.summary.inputs, run.replan_steps, *all_rates(run.summary, columns))


def all_rates(summary: Summary, columns: Sequence[str]) -> list[Rate]:
    """Return the metrics of memory types or suites and of the average, in the order of ``columns``."""
    absent = dict.fromkeys(summary.average, Rate(None, 0))
    found = {**summary.memory_types, **dict.fromkeys(PAPER_COLUMNS[-1:] * len(summary.means), summary.average)}
    return [rate for name in columns for rate in found.get(name, absent).values()]


def columns_of(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the groups of columns of a wide table: the paper's, or the suites of LIBERO and their average."""
    if runs[0].summary.grouping == MEMORY_TYPE:
        return PAPER_COLUMNS
    there = {name for run in runs for name in run.summary.memory_types}
    return tuple(name for name in GROUPS if name in there) + PAPER_COLUMNS[-1:] * (len(there) > 1)


def wide_table(
    key: str,
    title: str,
    rows: tuple[tuple[Cell, ...], ...],
    leading: tuple[str, ...] = LEADING,
    note: str = NOTE,
    strong: Iterable[int] = (),
    rules: Iterable[int] = (),
    best: frozenset[tuple[int, int]] = frozenset(),
    columns: Sequence[str] = PAPER_COLUMNS,
    metrics: Iterable[str] = METRICS,
) -> Table:
    """Return a table whose rows are some leading cells and then `all_rates`, under ``columns`` and ``metrics``."""
    metrics = tuple(metrics)
    return Table(
        key,
        title,
        (*leading, *(metrics * len(columns))),
        rows,
        note=note,
        groups=(*(("", 1) for _ in leading), *((name, len(metrics)) for name in columns)),
        strong=frozenset(strong),
        rules=frozenset(rules),
        best=best,
        intervals=False,
    )


def joined_table(runs: Sequence[Run]) -> Table:
    """Return one row per task, memory type and average, with the rates of all evaluations next to each other."""
    metrics = tuple(runs[0].summary.average)
    absent: Row = dict.fromkeys(metrics, Rate(None, 0))
    rows: list[tuple[Cell, ...]] = []
    strong, rules = [], []

    def add(name: Cell, found: Iterable[Row]) -> None:
        each = list(found)
        rows.append((name, *(row[metric] for metric in metrics for row in each)))

    for memory_type in GROUPS:
        names = dict.fromkeys(name for run in runs for name in _tasks_of(run.summary, memory_type))
        if not names:
            continue
        for name in names:
            add(Name(name), (run.summary.tasks.get(name, absent) for run in runs))
        strong.append(len(rows))
        add(memory_type, (run.summary.memory_types.get(memory_type, absent) for run in runs))
        rules.append(len(rows))
    for name in dict.fromkeys(name for run in runs for name in run.summary.means):
        strong.append(len(rows))
        add(name, (run.summary.means.get(name, absent) for run in runs))
    table = Table(
        "joined",
        "Rates by task",
        ("task", *(run.name for _ in metrics for run in runs)),
        tuple(rows),
        note="Per cent; – is not applicable. Intervals: in CSV, JSON and the report of each evaluation alone.",
        groups=(("", 1), *((metric, len(runs)) for metric in metrics)),
        strong=frozenset(strong),
        rules=frozenset(rules),
        intervals=False,
    )
    return with_ids(table)


# --- one method at several replan intervals ---


def sweep(method: str, runs: Sequence[Run]) -> Section:
    """Return the tables of one method at several replan intervals, and which interval is best for what."""
    averages = tuple((run.replan_steps, *rate_row(None, run.summary.average)[1:]) for run in runs)
    columns = columns_of(runs)
    types = tuple((run.replan_steps, *all_rates(run.summary, columns)) for run in runs)
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
        wide_table(
            f"replan-types-{slug}",
            f"{first.grouping.capitalize()}s by replan interval: {method}",
            types,
            leading=("replan interval",),
            note=inputs,
            best=best_in_columns(types),
            columns=columns,
            metrics=first.average,
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
    title, sentence = f"Replan sweep: {method}", f"Best replan interval by average: {', '.join(best)}."
    return Section(title, tables, (sentence,), tuple(notes))


def best_interval(runs: Sequence[Run], metric: str) -> tuple[list[int], Rate | None]:
    """Return the replan intervals with the highest average of a metric as printed, and that average."""
    found = [(percent(run.summary.average[metric].value), run) for run in runs]
    known = [value for value, _ in found if value is not None]
    if not known:
        return [], None
    best = [run for value, run in found if value == max(known)]
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
    return Section("With the paper's figures", (*tables, paper_failures()), notes=tuple(notes))


def extent(run: Run) -> str:
    """Return how many tasks and rollouts an evaluation is of, "" where it is as many as the paper's."""
    summary = run.summary
    if len(summary.tasks) == PAPER_TASKS and {row["SR"].n for row in summary.tasks.values()} == {PAPER_EPISODES}:
        return ""
    return f"{len(summary.tasks)} of {PAPER_TASKS} tasks, {count_of(summary.rollouts, 'rollout')}"


def _paper_table(runs: Sequence[Run], key: str, title: str, sources: Sequence[str]) -> Table:
    """Return a table of the paper's, ours on top, named with their extent: the paper ran 1,500 rollouts."""
    published = published_rows(*sources)
    names = [f"{run.name} ({size})" if (size := extent(run)) else run.name for run in runs]
    rows = (
        *((name, *run_row(run)[1:]) for name, run in zip(names, runs, strict=True)),
        *(_published_row(row) for row in published),
    )
    steps = [row.replan_steps for row in published]
    changes = {len(runs) + k for k in range(1, len(steps)) if steps[k] != steps[k - 1]}
    return wide_table(key, title, rows, strong=range(len(runs)), rules={len(runs), *changes})


def _published_row(row: PublishedRow) -> tuple[Cell, ...]:
    columns = [*(row.memory_types[name] for name in MEMORY_TYPES), row.average]
    return (
        f"paper: {row.label}",
        PAPER_INPUTS,
        row.replan_steps,
        *(published_rate(c[m]) for c in columns for m in METRICS),
    )


def published_rate(value: float | None) -> Rate:
    """Return a published percentage as a rate without interval: the paper gives none."""
    return Rate(None if value is None else value / 100, 0)


def paper_failures() -> Table:
    """Return how the paper's rollouts of its temporal task ended."""
    counts = failure_taxonomy()
    total = counts.pop("rollouts")
    rows = tuple((name.replace("_", " "), count, Rate(count / total, total)) for name, count in counts.items())
    return Table(
        "paper-failures",
        f"The paper's outcomes of {total} rollouts of a temporal task with the checkpoints S, U, U",
        ("outcome", "rollouts", "of all"),
        rows,
    )


def departures(run: Run) -> list[str]:
    """Return a phrase for each departure of an evaluation from the paper's protocol."""
    found = []
    if len(run.summary.tasks) != PAPER_TASKS:
        found.append(f"{len(run.summary.tasks)} of {PAPER_TASKS} tasks")
    counts = {row["SR"].n for row in run.summary.tasks.values()}
    if counts != {PAPER_EPISODES}:
        low, high = min(counts), max(counts)
        found.append(f"{low if low == high else f'{low} to {high}'} episodes of each instead of {PAPER_EPISODES}")
    known = with_omitted(run.protocol)
    for key, value in PAPER_PROTOCOL.items():
        if key in known and known[key] != value:
            found.append(f"{key.replace('_', ' ')} {known[key]} instead of {value}")
    return found
