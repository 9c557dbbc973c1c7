"""The report of an evaluation: a table for the terminal, Markdown for people, JSON for programs."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.table import Table

from lerobot_memobench.envs.episode_log import read_episodes, write_episodes
from lerobot_memobench.evaluation.metrics import (
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

REPORT_JSON = "report.json"
REPORT_MARKDOWN = "report.md"
NOT_APPLICABLE = "–"


def write_report(directory: str | Path, episodes: int | None = None) -> tuple[Summary, list[str]]:
    """Read the log under ``directory`` and write ``episodes.jsonl``, ``report.json`` and ``report.md`` into
    it.

    Args:
        episodes: report episodes 0 to ``episodes`` − 1 of each task; None for all. LeRobot runs whole
            batches, so its
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
    _replace(directory / REPORT_JSON, json.dumps(report(summary), indent=2) + "\n")
    _replace(directory / REPORT_MARKDOWN, markdown(summary, records, notes))
    return summary, notes


def _replace(path: Path, text: str) -> None:
    draft = path.with_name(path.name + ".part")
    draft.write_text(text)
    os.replace(draft, path)


# --- terminal ---


def table(summary: Summary, title: str | None = None) -> Table:
    """Return the table of SR, MSR, MUR, MCR per task, memory type and on average, in per cent."""
    result = Table(title=title, title_justify="left", header_style="bold", pad_edge=False)
    result.add_column("task", overflow="fold")
    result.add_column("n", justify="right")
    for metric in METRICS:
        result.add_column(metric, justify="right")
    for memory_type, row in summary.memory_types.items():
        names = [name for name, its_type in summary.memory_type_of.items() if its_type == memory_type]
        for name in names:
            result.add_row(name, *_cells(summary.tasks[name]))
        result.add_row(f"[bold]{memory_type}[/bold] ({_count(len(names), 'task')})", *_cells(row, "[bold]", "[/bold]"))
        result.add_section()
    result.add_row("[bold]average of memory types[/bold]", *_cells(summary.average, "[bold]", "[/bold]"))
    return result


def _count(number: int, word: str) -> str:
    return f"{number} {word}" + ("" if number == 1 else "s")


def _cells(row: Row, before: str = "", after: str = "") -> list[str]:
    return [str(row["SR"].n), *(f"{before}{_figure(row[metric])}{after}" for metric in METRICS)]


def _figure(rate: Rate) -> str:
    value = percent(rate.value)
    return NOT_APPLICABLE if value is None else f"{value:.1f}"


def failure_line(summary: Summary) -> str:
    """Return the failures in one line, for under the table."""
    failed = {name: count for name, count in summary.failures.items() if count}
    if not failed:
        return "no failed rollouts"
    return "failed rollouts: " + ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in failed.items())


# --- Markdown ---


def markdown(summary: Summary, records: Iterable[Record], notes: Sequence[str] = ()) -> str:
    """Return the report as Markdown, with Wilson intervals."""
    records = list(records)
    lines = ["# Evaluation report", "", _protocol_sentence(records), ""]
    lines += [f"> {note}\n" for note in notes]
    lines += [
        "SR is success, MSR, MUR and MCR the rates at which checkpoints of Storage, Update and Compression",
        "were satisfied at some step. Per cent, with the Wilson 95 % interval over n rollouts; – is not",
        "applicable.",
        "",
    ]
    lines += _rate_table("memory type", {**summary.memory_types, "**average**": summary.average})
    lines += ["", "## Tasks", ""]
    lines += _rate_table("task", {f"`{name}`": row for name, row in summary.tasks.items()})
    pooled = ", ".join(
        f"{metric} {_figure(summary.pooled[metric])} (n = {summary.pooled[metric].n})"
        for metric in METRICS
        if summary.pooled[metric].value is not None
    )
    lines += ["", f"Pooled over all rollouts and checkpoint records: {pooled}."]
    lines += ["", "## Prefix completion", ""]
    lines += [
        "Rollouts in which a checkpoint and all before it were satisfied, in any order / in order, per cent.",
        "",
    ]
    lines += _prefix_table(summary)
    lines += ["", "## Failures", "", "| class | rollouts |", "|---|---:|"]
    lines += [f"| {name.replace('_', ' ')} | {count} |" for name, count in summary.failures.items()]
    return "\n".join(lines) + "\n"


def _protocol_sentence(records: Sequence[Mapping[str, Any]]) -> str:
    seeds = sorted({record["seed"] for record in records if record.get("seed") is not None})
    referents = sorted({str(record.get("referent", "fixed")) for record in records})
    replans = sorted({str(r["replan_steps"]) for r in records if r.get("replan_steps") is not None})
    tasks = {record["task"] for record in records}
    parts = [f"{_count(len(records), 'rollout')} of {_count(len(tasks), 'task')}"]
    if seeds:
        parts.append(f"seeds {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"seed {seeds[0]}")
    parts.append(f"referent {', '.join(referents)}")
    if replans:
        parts.append(f"replan interval {', '.join(replans)}")
    return ", ".join(parts) + "."


def _rate_table(first: str, rows: Mapping[str, Row]) -> list[str]:
    lines = [
        f"| {first} | n | " + " | ".join(METRICS) + " |",
        "|---|---:|" + "---:|" * len(METRICS),
    ]
    for name, row in rows.items():
        lines.append(f"| {name} | {row['SR'].n} | " + " | ".join(_with_interval(row[m]) for m in METRICS) + " |")
    return lines


def _with_interval(rate: Rate) -> str:
    if rate.value is None or rate.interval is None:
        return NOT_APPLICABLE
    low, high = (percent(bound) for bound in rate.interval)
    return f"{_figure(rate)} [{low:.1f}, {high:.1f}]"


def _prefix_table(summary: Summary) -> list[str]:
    width = max(len(rates) for rates in summary.prefix.values())
    lines = [
        "| task | " + " | ".join(f"c{k + 1}" for k in range(width)) + " |",
        "|---|" + "---:|" * width,
    ]
    for name, rates in summary.prefix.items():
        ordered = summary.ordered_prefix[name]
        cells = [f"{_figure(a)} / {_figure(b)}" for a, b in zip(rates, ordered, strict=True)]
        lines.append(f"| `{name}` | " + " | ".join(cells + [""] * (width - len(cells))) + " |")
    return lines
