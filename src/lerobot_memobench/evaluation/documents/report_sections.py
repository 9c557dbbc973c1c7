"""What stands in a report: its tables and sentences, from the figures of evaluations and of the paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from lerobot_memobench.evaluation.documents.tables import (
    Cell,
    Count,
    Name,
    Numbers,
    Section,
    Table,
    best_in_columns,
    figure,
)
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, Record, Row, Summary, percent
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import PublishedRow, failure_taxonomy, published_rows
from lerobot_memobench.tasks.failures import FAILURES
from lerobot_memobench.tasks.task import MEMORY_TYPES

AVERAGE = "average of memory types"

HOW_TO_READ = (
    "SR is success, MSR, MUR and MCR the rates at which checkpoints of Storage, Update and Compression were satisfied "
    "at some step. Per cent, with the Wilson 95 % interval; n counts rollouts; – is not applicable."
)

PAPER_PROTOCOL = {"referent": "fixed", "prompt_video": True, "horizon": 1200, "seed_base": 7}
PAPER_TASKS, PAPER_EPISODES = 30, 50


# --- rates ---


def rates(summary: Summary) -> Table:
    """Return one table of all tasks, each memory type's after them, and the average."""
    rows: list[tuple[Cell, ...]] = []
    strong, rules = [], []
    for memory_type, row in summary.memory_types.items():
        if rows:
            rules.append(len(rows))
        names = [name for name, its_type in summary.memory_type_of.items() if its_type == memory_type]
        rows += [_rate_row(Name(name), summary.tasks[name]) for name in names]
        strong.append(len(rows))
        rows.append(_rate_row(f"{memory_type} ({count_of(len(names), 'task')})", row))
    rules.append(len(rows))
    strong.append(len(rows))
    rows.append(_rate_row(AVERAGE, summary.average))
    return Table("rates", "", ("task", "n", *METRICS), tuple(rows), strong=frozenset(strong), rules=frozenset(rules))


def memory_types(summary: Summary, title: str = "Rates by memory type") -> Table:
    rows = [_rate_row(name, row) for name, row in summary.memory_types.items()]
    return Table(
        "memory-types",
        title,
        ("memory type", "n", *METRICS),
        (*rows, _rate_row(AVERAGE, summary.average)),
        note=HOW_TO_READ,
        strong=frozenset({len(rows)}),
        rules=frozenset({len(rows)}),
    )


def tasks(summary: Summary) -> Table:
    names = list(summary.tasks)
    types = [summary.memory_type_of[name] for name in names]
    return Table(
        "tasks",
        "Rates by task",
        ("task", "n", *METRICS),
        tuple(_rate_row(Name(name), summary.tasks[name]) for name in names),
        rules=frozenset(k for k in range(1, len(types)) if types[k] != types[k - 1]),
    )


def _rate_row(name: Cell, row: Row) -> tuple[Cell, ...]:
    return (name, Count(row["SR"].n), *(row[metric] for metric in METRICS))


def pooled_sentence(summary: Summary) -> str:
    """Return the rates over all checkpoint records; no intervals, since records of one rollout are not independent."""
    parts = [
        f"{metric} {figure(rate.value)} ({rate.n} records)"
        for metric, rate in summary.pooled.items()
        if metric != "SR" and rate.value is not None
    ]
    overall = summary.pooled_checkpoints
    return (
        f"Pooled over all rollouts, whatever the task: SR {figure(summary.pooled['SR'].value)}, "
        f"checkpoints satisfied {figure(overall.value)} ({overall.n} records): {', '.join(parts)}."
    )


# --- prefix completion ---


def prefix(summary: Summary) -> Table:
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


def failures(summary: Summary) -> Table:
    """Return how rollouts ended, in all and by memory type."""
    counts: dict[str, Mapping[str, int]] = {"all": _outcomes(summary, list(summary.tasks))}
    for memory_type in summary.memory_types:
        names = [name for name, its_type in summary.memory_type_of.items() if its_type == memory_type]
        counts[memory_type] = _outcomes(summary, names)
    total = summary.rollouts
    rows: list[tuple[Cell, ...]] = []
    for outcome in ("success", *FAILURES):
        found = [Count(column[outcome]) for column in counts.values()]
        rows.append((outcome.replace("_", " "), *found, Rate(found[0] / total, total)))
    return Table(
        "failures",
        "Outcomes of rollouts",
        ("outcome", "rollouts", *list(counts)[1:], "of all"),
        tuple(rows),
        note=(
            "A failed rollout is named after the first checkpoint that was never satisfied: Storage, Update (stale "
            "memory) or Compression; reference drift where a wrong sibling took the place; execution failure where "
            "all checkpoints were satisfied."
        ),
        rules=frozenset({1}),
    )


def _outcomes(summary: Summary, names: Sequence[str]) -> dict[str, int]:
    found = {name: sum(summary.failures_of[task][name] for task in names) for name in FAILURES}
    return {"success": sum(summary.tasks[task]["SR"].n for task in names) - sum(found.values()), **found}


# --- replan sweep ---


def sweep(method: str, runs: Sequence[Run]) -> Section:
    """Return the tables of one method at several replan intervals, and which interval is best for what."""
    rows = tuple((run.replan_steps, *_rate_row(None, run.summary.average)[1:]) for run in runs)
    best = best_in_columns(rows)
    average = Table(
        f"replan-{_slug(method)}",
        f"Average by replan interval: {method}",
        ("replan interval", "n", *METRICS),
        rows,
        note=HOW_TO_READ,
        best=best,
    )
    wide = tuple((run.replan_steps, *_all_rates(run.summary)) for run in runs)
    types = Table(
        f"replan-types-{_slug(method)}",
        f"Memory types by replan interval: {method}",
        ("replan interval", *(tuple(METRICS) * (len(MEMORY_TYPES) + 1))),
        wide,
        groups=(("", 1), *((name, len(METRICS)) for name in (*MEMORY_TYPES, "average"))),
        best=best_in_columns(wide),
        intervals=False,
    )
    sentences = [
        f"{metric} {figure(rate.value)} at {' and '.join(map(str, steps))}"
        for metric in METRICS
        for steps, rate in [best_interval(runs, metric)]
        if rate is not None
    ]
    notes = []
    if len({frozenset(run.summary.tasks) for run in runs}) > 1:
        notes.append("the intervals were not evaluated on the same tasks; their averages do not compare")
    return Section(
        f"Replan sweep: {method}",
        (average, types),
        (f"Best replan interval by average: {', '.join(sentences)}.",),
        tuple(notes),
    )


def best_interval(runs: Sequence[Run], metric: str) -> tuple[list[int], Rate | None]:
    """Return the replan intervals with the highest average of a metric as printed, and that average."""
    found = [(percent(run.summary.average[metric].value), run) for run in runs]
    known = [value for value, _ in found if value is not None]
    if not known:
        return [], None
    best = [run for value, run in found if value == max(known)]
    return [run.replan_steps for run in best if run.replan_steps is not None], best[0].summary.average[metric]


def _all_rates(summary: Summary) -> list[Rate]:
    """Return the metrics of every memory type and of the average, in the paper's order."""
    absent = dict.fromkeys(METRICS, Rate(None, 0))
    rows = [*(summary.memory_types.get(name, absent) for name in MEMORY_TYPES), summary.average]
    return [row[metric] for row in rows for metric in METRICS]


# --- several evaluations, and the paper's ---


def overview(runs: Sequence[Run]) -> Table:
    """Return one row per evaluation in the layout of the paper's main table."""
    rows = tuple(_run_row(run) for run in runs)
    return _wide_table("overview", "Evaluations", rows, best=best_in_columns(rows))


def beside_paper(runs: Sequence[Run]) -> Section:
    """Return the paper's tables of rates with these evaluations on top of each, and in what they depart from it."""
    ours = [_run_row(run) for run in runs]
    titles = {
        "main": ("paper-main", "Beside the paper's main results", ("main",)),
        "alignment": ("paper-alignment", "Beside the paper's memory alignment results", ("alignment",)),
        "reference": ("paper-reference", "Beside the paper's oracle memory and MemER", ("oracle", "memer")),
    }
    tables = []
    for key, title, sources in titles.values():
        published = published_rows(*sources)
        rows = [*ours, *(_published_row(row) for row in published)]
        steps = [row.replan_steps for row in published]
        rules = {len(ours)} | {len(ours) + k for k in range(1, len(steps)) if steps[k] != steps[k - 1]}
        tables.append(_wide_table(key, title, tuple(rows), strong=range(len(ours)), rules=rules))
    notes = [f"{run.name} departs from the paper's protocol: {', '.join(d)}" for run in runs if (d := departures(run))]
    return Section("Beside the paper", (*tables, paper_failures()), notes=tuple(notes))


def _wide_table(
    key: str,
    title: str,
    rows: tuple[tuple[Cell, ...], ...],
    strong: Iterable[int] = (),
    rules: Iterable[int] = (),
    best: frozenset[tuple[int, int]] = frozenset(),
) -> Table:
    return Table(
        key,
        title,
        ("evaluation", "k", *(tuple(METRICS) * (len(MEMORY_TYPES) + 1))),
        rows,
        note="k is the replan interval.",
        groups=(("", 1), ("", 1), *((name, len(METRICS)) for name in (*MEMORY_TYPES, "average"))),
        strong=frozenset(strong),
        rules=frozenset(rules),
        best=best,
        intervals=False,
    )


def _run_row(run: Run) -> tuple[Cell, ...]:
    return (run.name, run.replan_steps, *_all_rates(run.summary))


def _published_row(row: PublishedRow) -> tuple[Cell, ...]:
    columns = [*(row.memory_types[name] for name in MEMORY_TYPES), row.average]
    return (f"paper: {row.label}", row.replan_steps, *(published_rate(c[m]) for c in columns for m in METRICS))


def published_rate(value: float | None) -> Rate:
    """Return a published percentage as a rate without interval: the paper gives none."""
    return Rate(None if value is None else value / 100, 0)


def paper_failures() -> Table:
    counts = failure_taxonomy()
    total = counts.pop("rollouts")
    rows = tuple((name.replace("_", " "), Count(count), Rate(count / total, total)) for name, count in counts.items())
    return Table(
        "paper-failures",
        f"The paper's outcomes of {total} rollouts of a temporal task with the checkpoints S, U, U",
        ("outcome", "rollouts", "of all"),
        rows,
    )


def departures(run: Run) -> list[str]:
    """Return in what an evaluation was not run as the paper's were, each as a phrase."""
    found = []
    if len(run.summary.tasks) != PAPER_TASKS:
        found.append(f"{len(run.summary.tasks)} of {PAPER_TASKS} tasks")
    counts = {row["SR"].n for row in run.summary.tasks.values()}
    if counts != {PAPER_EPISODES}:
        low, high = min(counts), max(counts)
        found.append(f"{low if low == high else f'{low} to {high}'} episodes of each instead of {PAPER_EPISODES}")
    for key, value in PAPER_PROTOCOL.items():
        if key in run.protocol and run.protocol[key] != value:
            found.append(f"{key.replace('_', ' ')} {run.protocol[key]} instead of {value}")
    return found


# --- sentences ---


def protocol_sentence(records: Sequence[Record]) -> str:
    """Return how many rollouts there are, of what, under which seeds, referent and replan interval."""
    seeds = sorted({record["seed"] for record in records if record.get("seed") is not None})
    referents = sorted({str(record.get("referent", "fixed")) for record in records})
    replans = sorted({record["replan_steps"] for record in records if record.get("replan_steps") is not None})
    parts = [f"{count_of(len(records), 'rollout')} of {count_of(len({r['task'] for r in records}), 'task')}"]
    if seeds:
        parts.append(f"seeds {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"seed {seeds[0]}")
    parts.append(f"referent {', '.join(referents)}")
    if replans:
        parts.append(f"replan interval {', '.join(map(str, replans))}")
    return ", ".join(parts) + "."


def failure_line(summary: Summary) -> str:
    """Return the failures in one line, for under a table."""
    failed = {name: count for name, count in summary.failures.items() if count}
    if not failed:
        return "no failed rollouts"
    return "failed rollouts: " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failed.items())


def count_of(number: int, word: str) -> str:
    return f"{number:,} {word}" + ("" if number == 1 else "s")


def _slug(name: str) -> str:
    return "-".join("".join(c if c.isalnum() and c.isascii() else " " for c in name).split()) or "policy"
