"""Reports as the terminal shows them, and the same as text for a file."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from lerobot_memobench.evaluation.documents.tables import Cell, Name, Report, Table, bounds, figure, plain
from lerobot_memobench.evaluation.metrics.rates import Rate

WIDTH = 140
"""Columns of a report that is written to a file."""

MOST_COLUMNS = 15
"""Columns of a table with groups that fit beside one another in a terminal."""


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


def text(report: Report) -> str:
    """Return what the terminal shows, as text for a file."""
    out = io.StringIO()
    Console(file=out, width=WIDTH, highlight=False, markup=False).print(terminal(report), crop=False)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()).strip("\n") + "\n"


class Unbroken:
    """A table in which no name is broken, however narrow the terminal is: to be printed with ``crop=False``.

    In a terminal that is too narrow names stand on lines of their own, each over its row; a file has no edge.

    Args:
        table: not to be changed any more. column: that of the names.
    """

    def __init__(self, table: RichTable, column: int = 0) -> None:
        self.table, self.column = table, column
        names = table.columns[column]
        names.no_wrap, names.overflow = True, "ignore"
        widths = [Measurement.get(PLAIN, PLAIN.options, cell).maximum for cell in names.cells]
        names.min_width = max(widths, default=1)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render the table as it is where it fits."""
        needed = Measurement.get(PLAIN, PLAIN.options, self.table)
        if needed.minimum <= options.max_width:
            yield self.table
        elif not console.is_terminal:
            yield from console.render(self.table, options.update(width=needed.maximum))
        else:
            yield from self._under_names(options.max_width)

    def _under_names(self, room: int) -> RenderResult:
        """Yield a row in two: what stands up to the name, and under it the rest."""
        columns = self.table.columns
        before, after = columns[: self.column + 1], columns[self.column + 1 :]
        wished = [[Measurement.get(PLAIN, PLAIN.options, cell) for cell in (c.header, *c.cells)] for c in after]
        least, most = ([max(one[end] for one in each) for each in wished] for end in (0, 1))
        space = room - INDENT * len(after)
        last = min(most[-1], space - sum(most[:-1]))  # text at the end of a row takes what is left
        widths = [*most[:-1], last] if last >= least[-1] else least

        def row(cells: Sequence[RenderableType], style: str = "") -> RichTable:
            line = RichTable(box=None, show_header=False, padding=(0, 0, 0, INDENT))
            for column, width in zip(after, widths, strict=True):
                line.add_column(justify=column.justify, width=width, overflow="fold")
            line.add_row(*cells, style=style)
            return line

        if self.table.title:
            yield Text(str(self.table.title), style="italic")
        yield row([column.header for column in after], "bold")
        cells = [list(column.cells) for column in columns]
        for k in range(self.table.row_count):
            yield Text(" ", no_wrap=True, overflow="ignore").join(
                cell if isinstance(cell, Text) else Text(str(cell))
                for cell in (cells[c][k] for c in range(len(before)))
            )
            yield row([cells[c][k] for c in range(len(before), len(columns))])
        if self.table.caption:
            yield Text(str(self.table.caption))


INDENT = 2

PLAIN = Console(width=10_000, markup=False, highlight=False)
"""What texts are measured with."""


def terminal_table(table: Table) -> RichTable | Unbroken:
    """Return a table for the terminal; an interval goes to a line of its own where it is narrow."""
    result = RichTable(
        title=table.title or None, title_justify="left", header_style="bold", pad_edge=False, box=box.SIMPLE_HEAD
    )
    for column, (title, name) in enumerate(zip(table.titles, table.header, strict=True)):
        # Rates are so narrow that a group's whole title does not fit over them.
        header = f"{title[:4]}.\n{name}" if title else name
        result.add_column(header, justify="left" if table.is_text(column) else "right", overflow="fold")
    for index in range(len(table.rows)):
        if index in table.rules:
            result.add_section()
        result.add_row(*_row(table, index))
    if table.best:
        result.caption = "* best of its column"
        result.caption_justify = "left"
    named = next((k for k in range(len(table.header)) if any(isinstance(row[k], Name) for row in table.rows)), None)
    return result if named is None else Unbroken(result, named)


def _row(table: Table, index: int) -> list[Text]:
    cells = []
    for column, cell in enumerate(table.rows[index]):
        best = (index, column) in table.best
        style = "bold" if best or index in table.strong else ""
        text = _cell(cell, table.intervals) + "*" * best
        whole = isinstance(cell, Name)
        cells.append(Text(text, style=style, no_wrap=whole or None, overflow="ignore" if whole else None))
    return cells


def _cell(cell: Cell, intervals: bool) -> str:
    if isinstance(cell, Rate):
        interval = bounds(cell) if intervals else None
        return figure(cell.value) + ("" if interval is None else f" [{interval[0]}–{interval[1]}]")
    return plain(cell)


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
    return replace(
        table,
        title=table.title if first else f"{table.title}, continued",
        header=tuple(table.header[column] for column in chosen),
        rows=tuple(tuple(row[column] for column in chosen) for row in table.rows),
        groups=tuple((table.titles[column], 1) for column in chosen),
        best=frozenset((row, chosen.index(column)) for row, column in table.best if column in chosen),
    )
