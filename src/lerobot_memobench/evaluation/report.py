"""The report of evaluations: for the terminal, Markdown, CSV, LaTeX, and JSON for programs.

``report.json`` in an evaluation's folder holds the keys of the benchmark's specification, and ``evidence`` where each
scene was run with each variant. The format JSON adds intervals, prefix completion in order, pooled rates and protocol;
of several evaluations also the controls among them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import read_lines, write_episodes
from lerobot_memobench.envs.evaluation_file import POLICY
from lerobot_memobench.evaluation.comparison import Comparison, comparison_data, comparison_section, controls_among
from lerobot_memobench.evaluation.controls import granularity_data, granularity_section
from lerobot_memobench.evaluation.evidence import evidence_data, evidence_section
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.metrics import Rate, Row, percent, report_values
from lerobot_memobench.evaluation.records import Run, read_run, sweeps, unlike
from lerobot_memobench.evaluation.report_tables import (
    best_interval,
    failures_table,
    inputs_sentence,
    joined_table,
    memory_types_table,
    overview,
    pooled_sentence,
    prefix_table,
    sweep,
    tasks_table,
)
from lerobot_memobench.evaluation.tables import Report, Section, markdown
from lerobot_memobench.io import write_file

REPORT_JSON = "report.json"
REPORT_MARKDOWN = "report.md"


# --- in the folder of the log ---


def write_report(directory: str | Path) -> Run:
    """Read the log under ``directory`` and write ``report.json`` and ``report.md`` into it.

    ``episodes.jsonl`` gets the lines of the workers' files that it lacks. The caller holds the folder (`locked`) where
    another process may write to it.

    Returns:
        The evaluation with warnings, see `read_run`.

    Raises:
        MemobenchError: see `read_run`.
    """
    directory = Path(directory)
    run = read_run(directory)
    write_episodes(directory, read_lines(directory, []))
    figures = {**report_values(run.summary), **evidence_values(run)}
    if run.not_run:
        figures["not_run"] = run.not_run
    if run.missing is not None:
        figures["missing"] = run.missing
    write_file(directory / REPORT_JSON, json.dumps(figures, indent=2) + "\n")
    write_file(directory / REPORT_MARKDOWN, evaluation_markdown(run))
    return run


def evaluation_markdown(run: Run) -> str:
    """Return the report of one evaluation as Markdown."""
    return markdown(Report(headline([run]), [_section(run), *_evidence(run)]))


# --- documents ---


def build(runs: Sequence[Run]) -> Report:
    """Return the report of one or several evaluations."""
    sections, controls = [], list(controls_among(runs))
    if len(runs) > 1:
        sections.append(Section("Evaluations", [overview(runs), joined_table(runs)], notes=unlike(runs)))
    sections += [sweep(method, group) for method, group in sweeps(runs).items()]
    sections += [comparison_section(each, overall=True) for each in controls]
    sections += granularity_section(runs)
    for run in runs:
        section = _section(run)
        if len(runs) > 1:  # their rates by task are joined
            where = f"Evaluation in {', '.join(str(each.folder) for each in run.evaluations)}."
            tables = [table for table in section.tables if table.key != "tasks"]
            section = replace(section, title=run.name, tables=tables, sentences=[where, *section.sentences])
        sections += [section, *_evidence(run)]
    return Report(headline(runs), sections, report_data(runs, controls))


def _section(run: Run) -> Section:
    summary = run.summary
    inputs = inputs_sentence(summary.inputs)
    prefixes = (prefix_table(summary),) if any(summary.prefix.values()) else ()
    tables = (memory_types_table(summary), tasks_table(summary), *prefixes, failures_table(summary))
    noted = [replace(table, note=f"{table.note} {inputs}".strip()) for table in tables]
    return Section("", noted, [pooled_sentence(summary)], run.notes)


def _evidence(run: Run) -> list[Section]:
    """Return the section of evidence, [] where scenes were not run with each variant."""
    return [] if run.evidence is None else [evidence_section(run.evidence)]


def evidence_values(run: Run) -> dict[str, Any]:
    """Return ``evidence`` with its rates as JSON values, {} where scenes were not run with each variant."""
    return {} if run.evidence is None else {"evidence": evidence_data(run.evidence, run.records)}


# --- JSON ---


def report_data(runs: Sequence[Run], controls: Sequence[Comparison]) -> dict[str, Any]:
    """Return the figures of one or several evaluations."""
    if len(runs) == 1:
        data = run_data(runs[0])
    else:
        data = {"evaluations": {run.name: run_data(run) for run in runs}, "notes": unlike(runs)}
        if controls:
            data["controls"] = [comparison_data(each, overall=True) for each in controls]
        if levels := granularity_data(runs):
            data["granularity"] = levels
    if swept := sweeps(runs):
        data["replan_sweep"] = {method: _sweep_data(group) for method, group in swept.items()}
    return data


def run_data(run: Run) -> dict[str, Any]:
    """Return the figures of one evaluation: the keys of ``report.json`` and more."""
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
            "tasks": {name: _intervals(row) for name, row in summary.tasks.items()},
            "memory_types": {name: _intervals(row) for name, row in summary.memory_types.items()},
            "average": _intervals(summary.average),
        },
        "ordered_prefix": {name: [percent(each.value) for each in rs] for name, rs in summary.ordered_prefix.items()},
        "pooled": {
            "checkpoints": _pooled(summary.pooled_checkpoints),
            **{metric: _pooled(rate) for metric, rate in summary.pooled.items()},
        },
        "failures_by_task": {name: dict(counts) for name, counts in summary.failures_of.items()},
        "missing": run.missing,
        "notes": list(run.notes),
    }


def _intervals(row: Row) -> dict[str, list[float | None] | None]:
    intervals = {metric: rate.interval for metric, rate in row.items()}
    return {metric: None if bounds is None else [*map(percent, bounds)] for metric, bounds in intervals.items()}


def _pooled(rate: Rate) -> dict[str, Any]:
    return {"percent": percent(rate.value), "n": rate.n}


def _sweep_data(runs: Sequence[Run]) -> dict[str, Any]:
    return {
        "best": {metric: best_interval(runs, metric)[0] for metric in runs[0].summary.average},
        "average": {
            str(run.replan_steps): {metric: percent(rate.value) for metric, rate in run.summary.average.items()}
            for run in runs
        },
    }
