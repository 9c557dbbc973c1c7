"""The report of evaluations: for the terminal, Markdown, CSV, LaTeX, and JSON for programs.

``report.json`` beside an evaluation's log holds exactly the keys of the benchmark's specification. As JSON among the
formats the same keys stand with more beside them: intervals, prefix completion in order, pooled rates, protocol.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import RenderableType

from lerobot_memobench.envs.episode_log import not_run, notes_on_not_run, read_log, write_episodes
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.documents import evaluation_tables as tables
from lerobot_memobench.evaluation.documents import formats, sentences
from lerobot_memobench.evaluation.documents.beside_paper import beside_paper, check_beside
from lerobot_memobench.evaluation.documents.replan_sweep import sweep
from lerobot_memobench.evaluation.documents.report_csv import HEADER, csv_rows
from lerobot_memobench.evaluation.documents.report_json import report_data
from lerobot_memobench.evaluation.documents.sentences import failure_line
from lerobot_memobench.evaluation.documents.tables import Report, Section
from lerobot_memobench.evaluation.documents.terminal import terminal_table
from lerobot_memobench.evaluation.documents.wide_tables import overview
from lerobot_memobench.evaluation.metrics.rollouts import Record, faults, mixtures
from lerobot_memobench.evaluation.metrics.summary import Summary, report, summarise
from lerobot_memobench.evaluation.records.runs import Run, asked_for, sweeps, unlike
from lerobot_memobench.io import write_file

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
        The figures, and notes a reader must know: unreadable lines, what was not run, mixed protocols.

    Raises:
        MemobenchError: there is no rollout: nothing was run, or nothing could be.
    """
    directory = Path(directory)
    notes: list[str] = []
    logged = asked_for(directory, read_log(directory, notes), notes)
    if episodes is not None:
        logged = [record for record in logged if record["episode"] < episodes]
    write_episodes(directory, logged)
    notes += notes_on_not_run(logged)
    records = [record for record in logged if "not_run" not in record]
    if logged and not records:
        raise MemobenchError(f"no episode in {directory} could be run; {'; '.join(notes)}")
    summary = summarise(records)
    notes += faults(records) + mixtures(records)
    unrun = {task: len(lines) for task, lines in not_run(logged).items()}
    figures = {**report(summary), **({"not_run": unrun} if unrun else {})}
    write_file(directory / REPORT_JSON, json.dumps(figures, indent=2) + "\n")
    write_file(directory / REPORT_MARKDOWN, markdown(summary, records, notes))
    return summary, notes


def table(summary: Summary, title: str | None = None) -> RenderableType:
    """Return the table of SR, MSR, MUR, MCR per task, memory type and on average, for the terminal."""
    return terminal_table(replace(tables.rates(summary), title=title or ""))


def markdown(summary: Summary, records: Iterable[Record], notes: Sequence[str] = ()) -> str:
    """Return the report of one evaluation as Markdown."""
    return formats.markdown(Report("Evaluation report", (_section(summary, list(records), notes),)))


# --- documents ---


def build(runs: Sequence[Run], paper: bool = False) -> Report:
    """Return the report of one or several evaluations.

    Args:
        paper: stand the published figures beside.

    Raises:
        MemobenchError: the published figures are wanted beside those of other tasks.
    """
    check_beside(runs, paper)
    found = []
    if len(runs) > 1:
        notes = unlike({run.name: run.protocol for run in runs})
        found.append(Section("Evaluations", (overview(runs),), notes=tuple(notes)))
    found += [sweep(method, group) for method, group in sweeps(runs).items()]
    for run in runs:
        section = _section(run.summary, run.records, run.notes)
        if len(runs) > 1:
            where = f"Evaluation in {run.folder}."
            section = replace(section, title=run.name, sentences=(where, *section.sentences))
        found.append(section)
    if paper:
        found.append(beside_paper(runs))
    return Report("Evaluation report", tuple(found), report_data(runs, paper))


def _section(summary: Summary, records: Sequence[Record], notes: Sequence[str]) -> Section:
    """Return the section of one evaluation, without a title."""
    seen = sentences.inputs_sentence(summary.inputs)
    made = (tables.memory_types(summary), tables.tasks(summary), tables.prefix(summary), tables.failures(summary))
    return Section(
        "",
        tuple(replace(each, note=f"{each.note} {seen}".strip()) for each in made),
        (sentences.protocol_sentence(records), sentences.pooled_sentence(summary)),
        tuple(notes),
    )


def render(found: Report, runs: Sequence[Run], format_: str, paper: bool = False) -> str:
    """Return a report in one of the formats of ``FILES``."""
    if format_ == "csv":
        return formats.csv_text(csv_rows(runs, paper), HEADER)
    if format_ not in formats.WRITERS:
        raise MemobenchError(f"found the format {format_!r}, {nearest(format_, FILES)}")
    return formats.WRITERS[format_](_unique_keys(found) if format_ == "latex" else found)


def write_documents(runs: Sequence[Run], out: Path, wanted: Sequence[str], paper: bool = False) -> list[Path]:
    """Write a report of evaluations into a folder in the formats wanted; return the files."""
    found = build(runs, paper)
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"--out {out} is a file; name a folder")
    out.mkdir(parents=True, exist_ok=True)
    return [write_file(out / FILES[name], render(found, runs, name, paper)) for name in wanted]


OF_EACH_EVALUATION = ("memory-types", "tasks", "prefix", "failures")
"""Keys of the tables that stand in the section of every evaluation."""


def _unique_keys(found: Report) -> Report:
    """Number the labels of tables that stand in several sections."""
    if len(found.sections) < 2:
        return found
    return replace(found, sections=tuple(_numbered(section, k) for k, section in enumerate(found.sections, start=1)))


def _numbered(section: Section, number: int) -> Section:
    numbered = []
    for each in section.tables:
        title = f"{each.title}: {section.title}" if section.title and each.key in OF_EACH_EVALUATION else each.title
        numbered.append(replace(each, key=f"{each.key}-{number}", title=title))
    return replace(section, tables=tuple(numbered))
