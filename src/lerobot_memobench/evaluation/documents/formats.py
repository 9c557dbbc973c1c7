"""Reports as terminal tables, Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console, Group, RenderableType
from rich.table import Table as RichTable
from rich.text import Text

from lerobot_memobench.evaluation.documents.tables import (
    NOT_APPLICABLE,
    Cell,
    Name,
    Report,
    Section,
    Table,
    bounds,
    figure,
)
from lerobot_memobench.evaluation.metrics.rates import Rate

TERMINAL_WIDTH = 140

# --- terminal ---


def terminal(report: Report, headings: bool = True) -> RenderableType:
    """Return a report for the terminal."""
    parts: list[RenderableType] = []
    for section in report.sections:
        if headings and section.title:
            parts.append(Text(f"\n{section.title}", style="bold underline"))
        parts += [terminal_table(part) for table in section.tables for part in _narrow(table)]
        parts += [Text(sentence) for sentence in section.sentences]
        parts += [Text(f"note: {note}") for note in section.notes]
    return Group(*parts)


def terminal_table(table: Table) -> RichTable:
    """Return a table for the terminal; an interval goes to a line of its own where it is narrow."""
    result = RichTable(
        title=table.title or None, title_justify="left", header_style="bold", pad_edge=False, box=box.SIMPLE_HEAD
    )
    titles = [title for title, span in table.groups for _ in range(span)] or [""] * len(table.header)
    for column, (title, name) in enumerate(zip(titles, table.header, strict=True)):
        # Rates are so narrow that a group's whole title does not fit over them.
        header = f"{title[:4]}.\n{name}" if title else name
        result.add_column(header, justify="left" if table.is_text(column) else "right", overflow="fold")
    for index, row in enumerate(table.rows):
        if index in table.rules:
            result.add_section()
        style = "bold" if index in table.strong else ""
        cells = [
            Text(
                _terminal_cell(cell, table.intervals) + ("*" if (index, column) in table.best else ""),
                style=style or ("bold" if (index, column) in table.best else ""),
            )
            for column, cell in enumerate(row)
        ]
        result.add_row(*cells)
    if table.best:
        result.caption = "* best of its column"
        result.caption_justify = "left"
    return result


MOST_COLUMNS = 14
"""Columns of a table with groups that fit beside one another in a terminal."""


def _narrow(table: Table) -> list[Table]:
    """Cut a table with groups of columns into several that fit; each keeps the columns before the first group."""
    leading = 0
    for title, span in table.groups:
        if title:
            break
        leading += span
    parts: list[list[int]] = [[]]
    column = leading
    for _, span in [group for group in table.groups if group[0]]:
        if parts[-1] and leading + len(parts[-1]) + span > MOST_COLUMNS:
            parts.append([])
        parts[-1] += range(column, column + span)
        column += span
    if len(parts) == 1:
        return [table]
    return [_columns(table, [*range(leading), *part], first=k == 0) for k, part in enumerate(parts)]


def _columns(table: Table, chosen: Sequence[int], first: bool) -> Table:
    """Return some columns of a table; the title is kept on the first part."""
    titles = [title for title, span in table.groups for _ in range(span)]
    groups = tuple((titles[column], 1) for column in chosen)
    return replace(
        table,
        title=table.title if first else f"{table.title}, continued",
        header=tuple(table.header[column] for column in chosen),
        rows=tuple(tuple(row[column] for column in chosen) for row in table.rows),
        groups=groups,
        best=frozenset((row, chosen.index(column)) for row, column in table.best if column in chosen),
    )


def _terminal_cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        return figure(cell.value) + ("" if interval is None else f" [{interval[0]}–{interval[1]}]")
    return _plain(cell)


def _plain(cell: Cell) -> str:
    return NOT_APPLICABLE if cell is None else str(cell)


def _full_header(table: Table) -> list[str]:
    """Return the header with the groups' titles before the names."""
    titles = [title for title, span in table.groups for _ in range(span)]
    return [
        f"{title} {name}" if title else name
        for title, name in zip(titles or [""] * len(table.header), table.header, strict=True)
    ]


def text(report: Report) -> str:
    """Return what the terminal shows, as text for a file."""
    out = io.StringIO()
    Console(file=out, width=TERMINAL_WIDTH, highlight=False).print(terminal(report))
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()).strip("\n") + "\n"


# --- Markdown ---


def markdown(report: Report) -> str:
    """Return a report as GitHub's Markdown."""
    lines = [f"# {report.title}", ""]
    for section in report.sections:
        lines += markdown_section(section)
    return "\n".join(lines).rstrip("\n") + "\n"


def markdown_section(section: Section) -> list[str]:
    lines = [f"## {_markdown_text(section.title)}", ""] if section.title else []
    for note in section.notes:
        lines += [f"> {note}", ""]
    for sentence in section.sentences:
        lines += [_markdown_text(sentence), ""]
    for table in section.tables:
        lines += [f"### {_markdown_text(table.title)}", ""] if table.title else []
        lines += [*markdown_table(table), ""]
        lines += [table.note, ""] if table.note else []
    return lines


def markdown_table(table: Table) -> list[str]:
    """Return the lines of a table in GitHub's Markdown."""
    rule = "|".join("---" if table.is_text(column) else "---:" for column in range(len(table.header)))
    lines = [_markdown_row(_full_header(table)), f"|{rule}|"]
    for index, row in enumerate(table.rows):
        cells = []
        for column, cell in enumerate(row):
            words = _markdown_cell(cell, table.intervals)
            emphasised = (index in table.strong and isinstance(cell, str)) or (index, column) in table.best
            cells.append(f"**{words}**" if emphasised and words else words)
        lines.append(_markdown_row(cells))
    return lines


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _markdown_cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        return figure(cell.value) + ("" if interval is None else f" [{interval[0]}, {interval[1]}]")
    if isinstance(cell, Name):
        return f"`{cell}`"
    return _markdown_text(_plain(cell))


def _markdown_text(words: str) -> str:
    return re.sub(r"([|*_`<>\\])", r"\\\1", words)


# --- LaTeX ---

_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "^": r"\textasciicircum{}",
    "~": r"\textasciitilde{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\textquotedbl{}",
    "[": "{[}",  # after the end of a row it would be taken as an option, as would a star
    "*": "{*}",
    "–": "--",
    "κ": r"$\kappa$",
    "π": r"$\pi$",
    "−": r"$-$",
    "×": r"$\times$",
    "±": r"$\pm$",
    "≥": r"$\geq$",
    "≤": r"$\leq$",
    "…": r"\ldots{}",
    "→": r"$\rightarrow$",
    "’": "'",
}


def latex_text(words: str) -> str:
    """Return text with every character that LaTeX would take as a command escaped."""
    words = re.sub(r"π(\d(?:\.\d)?)", "\0\\1\0", words)  # the models π0 and π0.5, set with an index
    escaped = "".join(_LATEX.get(character, character) for character in words)
    return re.sub("\0(.*?)\0", r"$\\pi_{\1}$", escaped)


def latex(report: Report) -> str:
    """Return the report's tables as LaTeX, to be read by ``\\input``; the head says which packages they need."""
    lines = [
        f"% {' '.join(report.title.split())}, written by `memobench report`.",
        r"% Needs \usepackage[T1]{fontenc}, \usepackage{booktabs} and \usepackage{graphicx}.",
    ]
    for section in report.sections:
        if section.title:
            lines += ["", f"% {' '.join(section.title.split())}"]
        for table in section.tables:
            lines += ["", *latex_table(table)]
    return "\n".join(lines) + "\n"


def latex_table(table: Table) -> list[str]:
    """Return the lines of a table in the style of booktabs."""
    columns = "".join("l" if table.is_text(column) else "r" for column in range(len(table.header)))
    lines = [
        r"\begin{table}",
        r"\centering",
        r"\small",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{@{{}}{columns}@{{}}}}",
        r"\toprule",
    ]
    if table.groups:
        cells, rules, column = [], [], 1
        for title, span in table.groups:
            cells.append(rf"\multicolumn{{{span}}}{{c}}{{{latex_text(title)}}}" if title else " & " * (span - 1))
            if title:
                rules.append(rf"\cmidrule(lr){{{column}-{column + span - 1}}}")
            column += span
        lines += [" & ".join(cells) + r" \\", " ".join(rules)]
    lines += [" & ".join(latex_text(name) for name in table.header) + r" \\", r"\midrule"]
    for index, row in enumerate(table.rows):
        if index in table.rules:
            lines.append(r"\midrule")
        cells = []
        for column, cell in enumerate(row):
            words = _latex_cell(cell, table.intervals)
            strong = index in table.strong or (index, column) in table.best
            cells.append(rf"\textbf{{{words}}}" if strong and words else words)
        lines.append(" & ".join(cells) + r" \\")
    caption = ". ".join(part.rstrip(".") for part in (table.title, table.note) if part)
    lines += [
        r"\bottomrule",
        r"\end{tabular}}",
        rf"\caption{{{latex_text(caption)}.}}",
        rf"\label{{tab:{table.key}}}",
        r"\end{table}",
    ]
    return lines


def _latex_cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        value = latex_text(figure(cell.value))
        return value + ("" if interval is None else rf" {{\scriptsize [{interval[0]}, {interval[1]}]}}")
    if isinstance(cell, Name):
        return rf"\texttt{{{latex_text(cell)}}}"
    return latex_text(_plain(cell))


# --- CSV ---


def csv_text(rows: Sequence[Sequence[object]], header: Sequence[str]) -> str:
    """Return rows as CSV (RFC 4180, but lines end in a plain line feed); None is an empty field."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(["" if value is None else value for value in row] for row in rows)
    return out.getvalue()
