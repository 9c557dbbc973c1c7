"""The report of evaluations: for the terminal, Markdown, CSV, LaTeX, and JSON for programs.

``report.json`` in an evaluation's folder holds the keys of the benchmark's specification, and ``evidence`` where each
scene was run with each variant. The format JSON adds intervals, prefix completion in order, pooled rates and protocol;
of several evaluations also the controls among them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import read_lines, write_episodes
from lerobot_memobench.envs.evaluation_file import POLICY
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.comparison import comparison_report, controls_among
from lerobot_memobench.evaluation.evidence import evidence_data, evidence_section
from lerobot_memobench.evaluation.metrics import (
    MEMORY_TYPE,
    METRICS,
    PAPER_METRICS,
    PROCESS_METRICS,
    SUITE,
    Rate,
    Record,
    Row,
    Summary,
    inputs_phrase,
    percent,
    report_values,
    summary_of,
)
from lerobot_memobench.evaluation.records import Run, headline, run_of, sweeps, unlike
from lerobot_memobench.evaluation.tables import (
    Cell,
    Name,
    Numbers,
    PrefixRates,
    Report,
    Section,
    Table,
    percent_text,
    to_markdown,
    with_ids,
)
from lerobot_memobench.io import write_file
from lerobot_memobench.tasks.catalogue import GROUPS, get_task, suite_of
from lerobot_memobench.tasks.task import LEVELS, MEMORY_TYPES

REPORT_JSON, REPORT_MARKDOWN = "report.json", "report.md"


# --- in the folder of the log ---


def write_report(directory: str | Path) -> Run:
    """Write ``report.json`` and ``report.md`` into the folder of a log, and return the evaluation, see `read_run`.

    ``episodes.jsonl`` gets the lines of the workers' files that it lacks. The caller holds the folder (`locked`) where
    another process may write to it.
    """
    directory, notes = Path(directory), list[str]()
    lines = read_lines(directory, notes)
    run = run_of(directory, lines, notes)
    write_episodes(directory, lines)  # also those that were not asked for
    values = {**report_values(run.summary), **evidence_values(run)}
    if run.not_run:
        values["not_run"] = run.not_run
    if run.missing is not None:
        values["missing"] = run.missing
    write_file(directory / REPORT_JSON, json.dumps(values, indent=2) + "\n")
    write_file(directory / REPORT_MARKDOWN, evaluation_markdown(run))
    return run


def evaluation_markdown(run: Run) -> str:
    """Return the report of one evaluation as Markdown."""
    return to_markdown(Report(headline([run]), _sections(run)))


# --- documents ---


def evaluation_report(runs: Sequence[Run]) -> Report:
    """Return the report of one or several evaluations, with its JSON values."""
    swept = sweeps(runs)
    sections = [sweep(method, group) for method, group in swept.items()]
    if len(runs) == 1:
        sections += _sections(runs[0])
        data = evaluation_data(runs[0])
    else:
        notes, levels = unlike(runs), granularity(runs)
        controls = [comparison_report(control, overall=True) for control in controls_among(runs)]
        sections = [
            Section("Evaluations", [evaluations_table(runs, notes), joined_table(runs)], notes=notes),
            *sections,
            *(section for control in controls for section in control.sections),
            *(levels.sections if levels else []),
        ]
        for run in runs:
            section, *evidence = _sections(run)
            where = f"Evaluation in {', '.join(str(evaluation.folder) for evaluation in run.evaluations)}."
            tables = [table for table in section.tables if table.key != "tasks"]  # rates by task are joined
            section = replace(section, title=run.name, tables=tables, sentences=[where, *section.sentences])
            sections += [section, *evidence]
        data = {"evaluations": {run.name: evaluation_data(run) for run in runs}, "notes": notes}
        if controls:
            data["controls"] = [control.data for control in controls]
        if levels:
            data["granularity"] = levels.data
    if swept:
        data["replan_sweep"] = {
            method: {
                "best": {metric: best_interval(group, metric)[0] for metric in group[0].summary.average},
                "average": {str(run.replan_steps): _percentages(run.summary.average) for run in group},
            }
            for method, group in swept.items()
        }
    return Report(headline(runs), sections, data)


def _sections(run: Run) -> list[Section]:
    summary = run.summary
    prefixes = [prefix_table(summary)] if any(task.prefix for task in summary.tasks.values()) else []
    tables = [memory_types_table(summary), tasks_table(summary), *prefixes, failures_table(summary)]
    noted = [replace(table, note=f"{table.note} Policy inputs: {summary.inputs}.".strip()) for table in tables]
    evidence = [] if run.evidence is None else [evidence_section(run.evidence)]
    return [Section("", noted, [pooled_sentence(summary)], run.notes), *evidence]


def evidence_values(run: Run) -> dict[str, Any]:
    """Return ``evidence`` with its rates as JSON values, {} where scenes were not run with each variant."""
    return {} if run.evidence is None else {"evidence": evidence_data(run.evidence, run.records)}


# --- JSON ---


def evaluation_data(run: Run) -> dict[str, Any]:
    """Return the JSON values of one evaluation: the keys of ``report.json`` and more."""
    summary = run.summary
    policy = run.protocol[POLICY]
    return {
        **report_values(summary),
        **evidence_values(run),
        "name": run.name,
        "method": run.method,
        "replan_steps": run.replan_steps,
        "protocol": {key: value for key, value in run.protocol.items() if key != POLICY},
        "policy": {key: policy.get(key) for key in ("type", "sha256", "seed")},
        "intervals": {
            "tasks": {name: _intervals(task.rates) for name, task in summary.tasks.items()},
            "memory_types": {name: _intervals(row) for name, row in summary.memory_types.items()},
            "average": _intervals(summary.average),
        },
        "ordered_prefix": {
            name: [percent(rate.value) for rate in task.ordered_prefix] for name, task in summary.tasks.items()
        },
        "pooled": {
            name: {"percent": percent(rate.value), "n": rate.n}
            for name, rate in {"checkpoints": summary.pooled_checkpoints, **summary.pooled}.items()
        },
        "failures_by_task": {name: dict(task.failures) for name, task in summary.tasks.items()},
        "missing": run.missing,
        "notes": list(run.notes),
    }


def _intervals(row: Row) -> dict[str, list[float | None] | None]:
    intervals = {metric: rate.interval for metric, rate in row.items()}
    return {metric: None if bounds is None else [*map(percent, bounds)] for metric, bounds in intervals.items()}


def _percentages(row: Row) -> dict[str, float | None]:
    return {metric: percent(rate.value) for metric, rate in row.items()}


# --- sentences ---


def pooled_sentence(summary: Summary) -> str:
    """Return the rates over all checkpoint records, without intervals: records of one rollout are not independent."""
    parts = [
        f"{metric} {percent_text(rate.value)} ({count_of(rate.n, 'record')})"
        for metric, rate in summary.pooled.items()
        if metric != "SR" and rate.value is not None
    ]
    sentence, overall = f"SR {percent_text(summary.pooled['SR'].value)}", summary.pooled_checkpoints
    if overall.n:
        records = count_of(overall.n, "record")
        sentence += f", checkpoints satisfied {percent_text(overall.value)} ({records}): {', '.join(parts)}"
    return f"Pooled over all rollouts of all tasks: {sentence}."


def failure_line(summary: Summary) -> str:
    """Return the failures in one line, for under a table."""
    failed = [f"{count} {name.replace('_', ' ')}" for name, count in summary.failures.items() if count]
    return f"failed rollouts: {', '.join(failed)}" if failed else "no failed rollouts"


# --- tables of one evaluation ---

HOW_TO_READ = {
    MEMORY_TYPE: "SR is success, MSR, MUR and MCR the rates at which checkpoints of Storage, Update and Compression "
    "were satisfied at some step. Per cent, with the Wilson 95 % interval; n counts rollouts; – is not applicable.",
    SUITE: "SR is success, per cent, with the Wilson 95 % interval; n counts rollouts.",
}
"""`Summary.grouping` -> note under a table of rates."""


def rates_table(summary: Summary) -> Table:
    """Return all tasks, each memory type's or suite's rates after its tasks, and the average."""
    rows: list[tuple[Cell, ...]] = []
    strong, rules = set(), set()
    for group, row in {**summary.memory_types, **summary.means}.items():
        rules.add(len(rows))
        names = summary.tasks_of(group)
        rows += [rate_row(Name(name), summary.tasks[name].rates) for name in names]
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
    types = [task.memory_type for task in summary.tasks.values()]
    rows = [rate_row(Name(name), task.rates) for name, task in summary.tasks.items()]
    rules = [k for k in range(1, len(types)) if types[k] != types[k - 1]]
    return with_ids(Table("tasks", "Rates by task", ("task", "n", *summary.average), rows, rules=rules))


def rate_row(name: Cell, row: Row) -> tuple[Cell, ...]:
    """Return name, n, metrics."""
    return (name, row["SR"].n, *row.values())


def prefix_table(summary: Summary) -> Table:
    """Return per task how many rollouts came as far as each checkpoint, in any order and in order."""
    width = max(len(task.prefix) for task in summary.tasks.values())
    rows = []
    for name, task in summary.tasks.items():
        cells: list[Cell] = [PrefixRates(*pair) for pair in zip(task.prefix, task.ordered_prefix, strict=True)]
        rows.append((Name(name), " ".join(task.operations), *cells, *[Numbers("")] * (width - len(cells))))
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
    """Return the outcomes of rollouts, in all and by memory type."""
    counts: dict[str, Mapping[str, int]] = {"all": outcomes(summary, summary.tasks)}
    for memory_type in summary.memory_types if len(summary.memory_types) > 1 else ():
        counts[memory_type] = outcomes(summary, summary.tasks_of(memory_type))
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
    """Return the number of rollouts of some tasks with each outcome: success, then the classes of failure."""
    tasks = [summary.tasks[name] for name in names]
    failed = {failure: sum(task.failures.get(failure, 0) for task in tasks) for failure in summary.failures}
    return {"success": sum(task.rates["SR"].n for task in tasks) - sum(failed.values()), **failed}


# --- several evaluations, in the layout of the paper's main table: every memory type's rates in one row ---

PAPER_COLUMNS = (*MEMORY_TYPES, "average")
"""Groups of columns of the paper's main table."""
LEADING = ("evaluation", "inputs", "k")
"""Columns before the rates."""
NOTE = "inputs: of the policy; k: the replan interval."


def evaluations_table(runs: Sequence[Run], notes: Sequence[str]) -> Table:
    """Return one row per evaluation, with notes on the settings in which they differ."""
    columns = columns_of(runs)
    rows = [run_row(run, columns) for run in runs]
    note = " ".join([NOTE, *notes])
    wide = wide_columns(LEADING, columns, runs[0].summary.average)
    return Table("overview", "Evaluations", rows=rows, note=note, mark_best=True, **wide)


def run_row(run: Run, columns: Sequence[str] = PAPER_COLUMNS) -> tuple[Cell, ...]:
    """Return the row of an evaluation: its cells under `LEADING`, and `all_rates`."""
    return (run.name, run.summary.inputs, run.replan_steps, *all_rates(run.summary, columns))


def all_rates(summary: Summary, columns: Sequence[str]) -> list[Rate]:
    """Return the metrics of memory types or suites and of the average, in the order of ``columns``."""
    absent = dict.fromkeys(summary.average, Rate(None, 0))
    rates = summary.memory_types | dict.fromkeys(PAPER_COLUMNS[-1:] * len(summary.means), summary.average)
    return [rate for name in columns for rate in rates.get(name, absent).values()]


def columns_of(runs: Sequence[Run]) -> tuple[str, ...]:
    """Return the groups of columns of a wide table."""
    if runs[0].summary.grouping == MEMORY_TYPE:
        return PAPER_COLUMNS
    suites = {name for run in runs for name in run.summary.memory_types}
    return tuple(name for name in GROUPS if name in suites) + PAPER_COLUMNS[-1:] * (len(suites) > 1)


def wide_columns(leading: tuple[str, ...], columns: Sequence[str], metrics: Iterable[str]) -> dict[str, Any]:
    """Return arguments of a table whose rows are leading cells, then ``metrics`` under each of ``columns``."""
    metrics = tuple(metrics)
    groups = (*("" for _ in leading), *(name for name in columns for _ in metrics))
    return {"header": (*leading, *metrics * len(columns)), "groups": groups, "intervals": False}


def joined_table(runs: Sequence[Run]) -> Table:
    """Return one row per task, memory type and average, with the rates of all evaluations."""
    metrics = tuple(runs[0].summary.average)
    absent: Row = dict.fromkeys(metrics, Rate(None, 0))
    summaries = [run.summary for run in runs]
    tasks = [{name: task.rates for name, task in summary.tasks.items()} for summary in summaries]
    rows: list[tuple[Cell, ...]] = []
    strong, rules = set(), set()

    def add(name: str, sources: Iterable[Mapping[str, Row]]) -> None:
        of_runs = [source.get(name, absent) for source in sources]
        rows.append((name, *(row[metric] for metric in metrics for row in of_runs)))

    overall = [summary.memory_types | summary.means for summary in summaries]
    for group in dict.fromkeys([*GROUPS, *(name for rates in overall for name in rates)]):
        names = dict.fromkeys(name for summary in summaries for name in summary.tasks_of(group))
        for name in names:
            add(Name(name), tasks)
        if any(group in rates for rates in overall):
            strong.add(len(rows))
            add(group, overall)
        if names:
            rules.add(len(rows))
    table = Table(
        "joined",
        "Rates by task",
        ("task", *(run.name for _ in metrics for run in runs)),
        rows,
        note="Per cent; – is not applicable. Intervals: in CSV, JSON and the report of each evaluation alone.",
        groups=("", *(metric for metric in metrics for _ in runs)),
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
    inputs = f"Policy inputs: {inputs_phrase(record for run in runs for record in run.records)}."
    slug = "-".join("".join(c if c.isalnum() and c.isascii() else " " for c in method).split()) or "policy"
    tables = (
        Table(
            f"replan-{slug}",
            f"Average by replan interval: {method}",
            ("replan interval", "n", *first.average),
            averages,
            note=f"{HOW_TO_READ[first.grouping]} {inputs}",
            mark_best=True,
        ),
        Table(
            f"replan-types-{slug}",
            f"{first.grouping.capitalize()}s by replan interval: {method}",
            rows=types,
            note=inputs,
            mark_best=True,
            **wide_columns(("replan interval",), columns, first.average),
        ),
    )
    best = [
        f"{metric} {percent_text(rate.value)} at {' and '.join(map(str, steps))}"
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


# --- annotation granularity ---


def granularity(runs: Sequence[Run]) -> Report | None:
    """Return rates under the labels of the subgoals taught to each policy; None unless these differ in their level."""
    levels = [(run, run.protocol[POLICY].get("settings", {}).get("subgoal_level")) for run in runs]
    known = [(run, level) for run, level in levels if level in LEVELS]
    if len({level for _, level in known}) < 2:
        return None
    rows: list[list[Cell]] = []
    data = {}
    for run, level in known:
        own = summary_of(with_labels_of(level, run.records)).average
        rows.append([run.name, level, *run.summary.average.values(), *(own[metric] for metric in PROCESS_METRICS)])
        data[run.name] = {"level": level, "own_labels": _percentages(own)}
    header = ("evaluation", "level", *METRICS, *(f"{metric}, own labels" for metric in PROCESS_METRICS))
    sentence = (
        f"MSR, MUR and MCR are given under the evaluated (intermediate) labels and under those of each policy's own "
        f"level: average of {MEMORY_TYPE}s, per cent, with Wilson's 95 % interval over rollouts."
    )
    title = "Annotation granularity"
    return Report(title, [Section(title, [Table("granularity", "", header, rows)], [sentence])], data)


def with_labels_of(level: str, records: Sequence[Record]) -> list[Record]:
    """Return rollouts with the operation labels of a subgoal level; tasks that the catalogue lacks keep theirs."""
    index = LEVELS.index(level)
    result: list[Record] = []
    for record in records:
        if suite_of(record["task"]) is None:
            result.append(record)
            continue
        labels = [checkpoint.operations_by_level[index] for checkpoint in get_task(record["task"]).checkpoints]
        if len(labels) != len(record["checkpoints"]):
            raise MemobenchError(
                f"a rollout of {record['task']!r} has {len(record['checkpoints'])} checkpoints, its task has "
                f"{len(labels)}; the log was written by another version of the task"
            )
        marks = zip(record["checkpoints"], labels, strict=True)
        result.append({**record, "checkpoints": [{**mark, "operation": label} for mark, label in marks]})
    return result


# --- the Hugging Face hub ---

HUB_FILE = ".eval_results/memobench.yaml"
"""Place of the results in a model's repository."""


def huggingface_yaml(run: Run, dataset: str) -> str:
    """Return the content of `HUB_FILE`; ``dataset`` is the benchmark's on the hub, as ``user/name``."""
    import yaml
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    suite = run.protocol["suite"]
    conditions = "; ".join([headline([run]), *([run.missing] if run.missing else [])])
    entries = [
        EvalResultEntry(
            dataset_id=dataset,
            task_id=f"{suite}_{metric.lower()}",
            value=percent(rate.value),
            date=str(run.card["written"])[:10] if "written" in run.card else None,
            notes=f"{conditions}{_interval(rate)}",
        )
        for metric in PAPER_METRICS
        if (rate := run.summary.average[metric]).value is not None
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(entries), sort_keys=False, allow_unicode=True)


def _interval(rate: Rate) -> str:
    return "" if rate.interval is None else "; 95 % interval {} to {}".format(*map(percent, rate.interval))
