"""Reports as GitHub's Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence

from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Section, Table, bounds, figure, plain
from lerobot_memobench.evaluation.metrics.rates import Rate


def markdown(report: Report) -> str:
    """Return a report as GitHub's Markdown."""
    lines = [f"# {report.title}", ""]
    for section in report.sections:
        lines += markdown_section(section)
    return "\n".join(lines).rstrip("\n") + "\n"


def markdown_section(section: Section) -> list[str]:
    """Return the lines of a section: heading, notes, sentences, tables."""
    lines = [f"## {_escaped(section.title)}", ""] if section.title else []
    for note in section.notes:
        lines += [f"> {note}", ""]
    for sentence in section.sentences:
        lines += [_escaped(sentence), ""]
    for table in section.tables:
        lines += [f"### {_escaped(table.title)}", ""] if table.title else []
        lines += [*markdown_table(table), ""]
        lines += [table.note, ""] if table.note else []
    return lines


def markdown_table(table: Table) -> list[str]:
    """Return the lines of a table in GitHub's Markdown."""
    rule = "|".join("---" if table.is_text(column) else "---:" for column in range(len(table.header)))
    lines = [_row(_header(table)), f"|{rule}|"]
    for index, row in enumerate(table.rows):
        cells = []
        for column, cell in enumerate(row):
            words = _cell(cell, table.intervals)
            emphasised = (index in table.strong and isinstance(cell, str)) or (index, column) in table.best
            cells.append(f"**{words}**" if emphasised and words else words)
        lines.append(_row(cells))
    return lines


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        return figure(cell.value) + ("" if interval is None else f" [{interval[0]}, {interval[1]}]")
    if isinstance(cell, Name):
        return f"`{cell}`"
    return _escaped(plain(cell))


def _escaped(words: str) -> str:
    return re.sub(r"([|*_`<>\\])", r"\\\1", words)


def _header(table: Table) -> list[str]:
    """Return the header with the groups' titles before the names."""
    return [f"{title} {name}" if title else name for title, name in zip(table.titles, table.header, strict=True)]
