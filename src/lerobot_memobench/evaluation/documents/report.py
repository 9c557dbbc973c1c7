"""The report of evaluations: for the terminal, Markdown, CSV, LaTeX, and JSON for programs.

``report.json`` beside an evaluation's log holds exactly the keys of the benchmark's specification. As JSON among the
formats the same keys stand with more beside them: intervals, prefix completion in order, pooled rates, protocol.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Any

from rich.table import Table as RichTable

from lerobot_memobench.envs.episode_log import read_episodes, write_episodes
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.documents import formats
from lerobot_memobench.evaluation.documents import report_sections as sections
from lerobot_memobench.evaluation.documents.report_sections import failure_line
from lerobot_memobench.evaluation.documents.tables import Report, Section
from lerobot_memobench.evaluation.metrics.rates import (
    METRICS,
    Rate,
    Record,
    Row,
    Summary,
    mixtures,
    percent,
    report,
    summarise,
)
from lerobot_memobench.evaluation.records.protocol import POLICY
from lerobot_memobench.evaluation.records.runs import Run, sweeps
from lerobot_memobench.paper import published_rows

__all__ = [
    "FILES",
    "REPORT_JSON",
    "REPORT_MARKDOWN",
    "build",
    "failure_line",
    "markdown",
    "render",
    "table",
    "write_documents",
    "write_report",
]

REPORT_JSON = "report.json"
REPORT_MARKDOWN = "report.md"

FILES: dict[str, str] = {
    "table": "report.txt",
    "markdown": REPORT_MARKDOWN,
    "csv": "report.csv",
    "latex": "report.tex",
    "json": REPORT_JSON,
}
"""Format -> file that it is written to."""


# --- beside the log ---


def write_report(directory: str | Path, episodes: int | None = None) -> tuple[Summary, list[str]]:
    """Read the log under ``directory`` and write ``episodes.jsonl``, ``report.json`` and ``report.md`` into it.

    Args:
        episodes: report episodes 0 to ``episodes`` − 1 of each task; None for all. LeRobot runs whole batches, so its
            last one may hold more than were asked for.

    Returns:
        The figures, and notes a reader must know: unreadable lines, mixed protocols.
    """
    directory = Path(directory)
    notes: list[str] = []
    records = read_episodes(directory, notes)
    if episodes is not None:
        records = [record for record in records if record["episode"] < episodes]
    summary = summarise(records)
    notes += mixtures(records)
    write_episodes(directory, records)
    put(directory / REPORT_JSON, json.dumps(report(summary), indent=2) + "\n")
    put(directory / REPORT_MARKDOWN, markdown(summary, records, notes))
    return summary, notes


def put(path: Path, content: str | bytes) -> Path:
    """Write a file whole or not at all."""
    draft = path.with_name(f".{path.name}.part")
    draft.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)
    os.replace(draft, path)
    return path


def table(summary: Summary, title: str | None = None) -> RichTable:
    """Return the table of SR, MSR, MUR, MCR per task, memory type and on average, for the terminal."""
    found = formats.terminal_table(sections.rates(summary))
    found.title = title
    return found


def markdown(summary: Summary, records: Iterable[Record], notes: Sequence[str] = ()) -> str:
    """Return the report of one evaluation as Markdown."""
    section = _section("", summary, list(records), notes)
    return formats.markdown(Report("Evaluation report", (section,)))


# --- documents ---


def build(runs: Sequence[Run], paper: bool = False) -> Report:
    """Return the report of one or several evaluations.

    Args:
        paper: stand the published figures beside.
    """
    found = []
    if len(runs) > 1:
        found.append(Section("Evaluations", (sections.overview(runs),)))
    found += [sections.sweep(method, group) for method, group in sweeps(runs).items()]
    for run in runs:
        section = _section("", run.summary, run.records, run.notes)
        if len(runs) > 1:
            section = replace_fields(
                section, title=run.name, sentences=(f"Evaluation in {run.folder}.", *section.sentences)
            )
        found.append(section)
    if paper:
        found.append(sections.beside_paper(runs))
    return Report("Evaluation report", tuple(found), _data(runs, paper))


def _section(title: str, summary: Summary, records: Sequence[Record], notes: Sequence[str]) -> Section:
    return Section(
        title,
        (
            sections.memory_types(summary),
            sections.tasks(summary),
            sections.prefix(summary),
            sections.failures(summary),
        ),
        (sections.protocol_sentence(records), sections.pooled_sentence(summary)),
        tuple(notes),
    )


def render(found: Report, runs: Sequence[Run], format_: str, paper: bool = False) -> str:
    """Return a report in one of the formats of ``FILES``."""
    if format_ == "table":
        return formats.text(found)
    if format_ == "markdown":
        return formats.markdown(found)
    if format_ == "latex":
        return formats.latex(_unique_keys(found))
    if format_ == "json":
        return json.dumps(found.data, indent=2) + "\n"
    if format_ == "csv":
        return formats.csv_text(_csv_rows(runs, paper), CSV_HEADER)
    raise MemobenchError(f"found the format {format_!r}, {nearest(format_, FILES)}")


def write_documents(runs: Sequence[Run], out: Path, wanted: Sequence[str], paper: bool = False) -> list[Path]:
    """Write a report of evaluations into a folder in the formats wanted; return the files."""
    found = build(runs, paper)
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"--out {out} is a file; name a folder")
    out.mkdir(parents=True, exist_ok=True)
    return [put(out / FILES[name], render(found, runs, name, paper)) for name in wanted]


def _unique_keys(found: Report) -> Report:
    """Number the labels of tables that stand in several sections."""
    if len(found.sections) < 2:
        return found
    numbered = [
        replace_fields(
            section,
            tables=tuple(
                replace_fields(
                    each,
                    key=f"{each.key}-{number}",
                    title=f"{each.title}: {section.title}" if _repeats(each.key) and section.title else each.title,
                )
                for each in section.tables
            ),
        )
        for number, section in enumerate(found.sections, start=1)
    ]
    return replace_fields(found, sections=tuple(numbered))


def _repeats(key: str) -> bool:
    """Whether a table stands in the section of every evaluation."""
    return key in ("memory-types", "tasks", "prefix", "failures")


# --- JSON ---


def _data(runs: Sequence[Run], paper: bool) -> dict[str, Any]:
    found: dict[str, Any]
    if len(runs) == 1:
        found = run_data(runs[0])
    else:
        found = {"evaluations": {run.name: run_data(run) for run in runs}}
    if swept := sweeps(runs):
        found["replan_sweep"] = {method: _sweep_data(group) for method, group in swept.items()}
    if paper:
        found["paper"] = [
            {
                "table": row.table,
                "model": row.model,
                "replan_steps": row.replan_steps,
                "memory_types": {name: dict(figures) for name, figures in row.memory_types.items()},
                "average": dict(row.average),
            }
            for row in published_rows()
        ]
    return found


def run_data(run: Run) -> dict[str, Any]:
    """Return the figures of one evaluation: the keys of ``report.json``, and more beside them."""
    summary = run.summary
    policy = run.protocol.get(POLICY) or {}
    return {
        **report(summary),
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
        "ordered_prefix": {
            name: [percent(rate.value) for rate in rates] for name, rates in summary.ordered_prefix.items()
        },
        "pooled": {
            "checkpoints": _pooled(summary.pooled_checkpoints),
            **{metric: _pooled(rate) for metric, rate in summary.pooled.items()},
        },
        "failures_by_task": {name: dict(counts) for name, counts in summary.failures_of.items()},
        "notes": list(run.notes),
    }


def _intervals(row: Row) -> dict[str, list[float | None] | None]:
    return {metric: _interval(row[metric]) for metric in METRICS}


def _interval(rate: Rate) -> list[float | None] | None:
    interval = rate.interval if rate.trials else None
    return None if interval is None else [percent(bound) for bound in interval]


def _pooled(rate: Rate) -> dict[str, Any]:
    return {"percent": percent(rate.value), "n": rate.n}


def _sweep_data(runs: Sequence[Run]) -> dict[str, Any]:
    return {
        "best": {metric: sections.best_interval(runs, metric)[0] for metric in METRICS},
        "average": {
            str(run.replan_steps): {metric: percent(run.summary.average[metric].value) for metric in METRICS}
            for run in runs
        },
    }


# --- CSV ---

CSV_HEADER = ("evaluation", "replan_steps", "table", "name", "figure", "percent", "low", "high", "n")
"""One figure a row: ``table`` is tasks, memory_types, average, pooled, prefix, ordered_prefix or failures."""


def _csv_rows(runs: Sequence[Run], paper: bool) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for run in runs:
        for place, name, figure, rate in _figures(run.summary):
            # Records of one rollout are not independent: an interval over them would be too narrow.
            interval = None if place == "pooled" and figure != "SR" else _interval(rate)
            low, high = interval or (None, None)
            rows.append(
                (run.name, run.replan_steps, place, name, figure, percent(rate.value), low, high, rate.n or None)
            )
    if paper:
        for published in published_rows():
            name = f"paper, {published.table}: {published.model}"
            groups: list[tuple[str, str, Mapping[str, float | None]]] = [
                *(("memory_types", key, figures) for key, figures in published.memory_types.items()),
                ("average", "", published.average),
            ]
            rows += [
                (name, published.replan_steps, place, key, metric, figures[metric], None, None, None)
                for place, key, figures in groups
                for metric in METRICS
            ]
    return rows


def _figures(summary: Summary) -> list[tuple[str, str, str, Rate]]:
    """Return (table, name, figure, rate) of everything in a summary."""
    found = [("tasks", name, metric, row[metric]) for name, row in summary.tasks.items() for metric in METRICS]
    found += [
        ("memory_types", name, metric, row[metric]) for name, row in summary.memory_types.items() for metric in METRICS
    ]
    found += [("average", "", metric, summary.average[metric]) for metric in METRICS]
    found += [("pooled", "", metric, rate) for metric, rate in summary.pooled.items()]
    found.append(("pooled", "", "checkpoints", summary.pooled_checkpoints))
    for place, rates in (("prefix", summary.prefix), ("ordered_prefix", summary.ordered_prefix)):
        found += [(place, name, f"c{k + 1}", rate) for name, row in rates.items() for k, rate in enumerate(row)]
    total = summary.rollouts
    found += [("failures", "", name, Rate(count / total, total)) for name, count in summary.failures.items()]
    return found
