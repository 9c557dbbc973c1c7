"""Tables of a report and their formats: terminal, text, Markdown, LaTeX, JSON, CSV."""

from __future__ import annotations

import csv
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import groupby
from typing import Any, NamedTuple

from rich import box
from rich.console import Console, ConsoleOptions, Group, OverflowMethod, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table as RichTable
from rich.text import Text

from lerobot_memobench.evaluation.metrics import Rate, percent
from lerobot_memobench.tasks.catalogue import libero_id

NOT_APPLICABLE = "–"

OPERATION_NAMES = {"S": "Storage", "U": "Update", "C": "Compression"}


class Name(str):
    """Text that is an identifier, such as a task's name: Markdown and LaTeX set it in typewriter."""


class Numbers(str):
    """Numbers written out; set flush right."""


class PrefixRates(NamedTuple):
    """Two rates in one cell."""

    any_order: Rate
    in_order: Rate


Cell = Rate | PrefixRates | str | int | None
"""A rate (per cent, with its interval where it has one) or two, text, a number; None: not applicable."""


@dataclass(frozen=True)
class Table:
    """A table and its note.

    Attributes:
        key: short name, unique in a report.
        groups: title over each column, "" for none; neighbours with equal titles are one group.
        strong: rows that sum up, by index. rules: rows before which a line is drawn.
        mark_best: whether the best rates of each column are marked.
        intervals: whether rates are followed by their interval; CSV always has its bounds.
    """

    key: str
    title: str
    header: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    note: str = ""
    groups: Sequence[str] = ()
    strong: Collection[int] = ()
    rules: Collection[int] = ()
    mark_best: bool = False
    intervals: bool = True

    @property
    def names(self) -> list[str]:
        """The name of each column after the title of its group."""
        return [f"{title} {name}".lstrip() for title, name in zip(self.titles, self.header, strict=True)]

    @property
    def titles(self) -> Sequence[str]:
        """The title of the group over each column, "" for none."""
        return self.groups or [""] * len(self.header)

    @cached_property
    def best(self) -> set[tuple[int, int]]:
        """The cells, (row, column), with the highest rate of their column, all of them where they tie as printed."""
        best = set[tuple[int, int]]()
        for column, cells in enumerate(zip(*self.rows, strict=True) if self.mark_best else ()):
            printed = {row: percent(cell.value) for row, cell in enumerate(cells) if isinstance(cell, Rate)}
            highest = max((value for value in printed.values() if value is not None), default=None)
            if len(printed) > 1 and highest is not None:
                best |= {(row, column) for row, value in printed.items() if value == highest}
        return best

    def text(self, cell: Cell, interval: str = " [{}–{}]", escape: Callable[[str], str] = str) -> str:
        """Return a cell as text; ``interval`` is the format of an interval."""
        if isinstance(cell, PrefixRates):
            return escape(" / ".join(percent_text(rate.value) for rate in cell))
        if not isinstance(cell, Rate):
            return escape(NOT_APPLICABLE if cell is None else str(cell))
        bounds = cell.interval if self.intervals else None
        return escape(percent_text(cell.value)) + (interval.format(*map(percent_text, bounds)) if bounds else "")

    def is_text(self, column: int) -> bool:
        """Return whether a column holds text and is therefore set flush left."""
        return any(isinstance(row[column], str) and not isinstance(row[column], Numbers) for row in self.rows)


@dataclass(frozen=True)
class Section:
    """Tables and sentences under one heading."""

    title: str
    tables: Sequence[Table] = ()
    sentences: Sequence[str] = ()
    notes: Sequence[str] = ()


@dataclass(frozen=True)
class Report:
    """A report: sections, and the same values as JSON."""

    title: str
    sections: Sequence[Section]
    data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def tables(self) -> list[Table]:
        """The tables of all sections."""
        return [table for section in self.sections for table in section.tables]


def percent_text(value: float | None, sign: bool = False) -> str:
    """Return a fraction as a percentage with one decimal."""
    return NOT_APPLICABLE if value is None else f"{percent(value):{'+' if sign else ''}.1f}"


def with_interval(value: float | None, low: float | None, high: float | None) -> str:
    """Return a fraction and its interval as percentages: ``97.8 [95.2–99.0]``."""
    return f"{percent_text(value)} [{percent_text(low)}–{percent_text(high)}]"


def with_ids(table: Table) -> Table:
    """Return a table with LIBERO's id of each task before its name in the first column, where any task has one."""
    ids = [libero_id(row[0]) if isinstance(row[0], Name) else None for row in table.rows]
    if all(number is None for number in ids):
        return table
    return replace(
        table,
        header=("id", *table.header),
        rows=[(Numbers("" if k is None else k), *row) for k, row in zip(ids, table.rows, strict=True)],
        groups=("", *table.groups) if table.groups else (),
    )


# --- GitHub's Markdown ---


def to_markdown(report: Report) -> str:
    """Return a report as GitHub's Markdown."""
    lines = [f"# {markdown_text(report.title)}", ""]
    for section in report.sections:
        lines += [f"## {markdown_text(section.title)}", ""] if section.title else []
        for note in section.notes:
            lines += [f"> {_paragraph(note)}", ""]
        for sentence in section.sentences:
            lines += [_paragraph(sentence), ""]
        for table in section.tables:
            lines += [f"### {markdown_text(table.title)}", ""] if table.title else []
            lines += [*markdown_table(table), ""]
            lines += [_paragraph(table.note), ""] if table.note else []
    return "\n".join(lines).rstrip("\n") + "\n"


def markdown_table(table: Table) -> list[str]:
    """Return the lines of a table in GitHub's Markdown."""
    rule = "|".join("---" if table.is_text(column) else "---:" for column in range(len(table.header)))
    lines = [f"| {' | '.join(map(markdown_text, table.names))} |", f"|{rule}|"]
    for index, row in enumerate(table.rows):
        cells = []
        for column, cell in enumerate(row):
            code = isinstance(cell, Name) and re.fullmatch(r"[\w.+-]+", cell)
            words = f"`{cell}`" if code else table.text(cell, " [{}, {}]", markdown_text)
            emphasised = (index in table.strong and isinstance(cell, str)) or (index, column) in table.best
            cells.append(f"**{words}**" if emphasised and words else words)
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def markdown_text(words: str) -> str:
    """Return text in one line with every mark of Markdown escaped: names and notes may be of strangers."""
    line = " ".join("".join(c if c.isprintable() else " " for c in words).split())
    # Within a word, an underscore is no mark.
    return re.sub(r"([|*`<>~\[\]\\]|&(?=#?\w+;)|(?<![^\W_])_|_(?![^\W_]))", r"\\\1", line)


def _paragraph(words: str) -> str:
    # At the begin of a line, marks of headings, lists and rules count as well.
    return re.sub(r"^(\d*)([-+=#.)])", r"\1\\\2", markdown_text(words))


# --- LaTeX in the style of booktabs ---

_LATEX = {character: rf"\{character}" for character in "{}$&#%_"} | {
    **{"\\": r"\textbackslash{}", "^": r"\textasciicircum{}", "~": r"\textasciitilde{}", "|": r"\textbar{}"},
    **{"<": r"\textless{}", ">": r"\textgreater{}", '"': r"\textquotedbl{}", "…": r"\ldots{}"},
    **{"[": "{[}", "*": "{*}"},  # after the end of a row they would be taken as an option
    **{"–": "--", "’": "'", "κ": r"$\kappa$", "π": r"$\pi$", "−": r"$-$", "×": r"$\times$", "±": r"$\pm$"},
    **{"≥": r"$\geq$", "≤": r"$\leq$", "→": r"$\rightarrow$"},
}


def latex_text(words: str) -> str:
    """Return text with every character that LaTeX would take as a command escaped."""
    words = re.sub(r"π(\d(?:\.\d)?)", "\0\\1\0", words)  # the models π0 and π0.5, set with an index
    escaped = "".join(_LATEX.get(character, character) for character in words)
    return re.sub("\0(.*?)\0", r"$\\pi_{\1}$", escaped)


def to_latex(report: Report) -> str:
    """Return the report's tables as LaTeX, to be read by ``\\input``; the head names the packages they need."""
    lines = [
        f"% {' '.join(report.title.split())}, written by `memobench report`.",
        r"% Needs \usepackage[T1]{fontenc}, \usepackage{booktabs} and \usepackage{graphicx}.",
    ]
    keys = Counter(table.key for table in report.tables)
    for number, section in enumerate(report.sections, start=1):
        if section.title:
            lines += ["", f"% {' '.join(section.title.split())}"]
        lines += [f"% note: {' '.join(note.split())}" for note in section.notes]
        for table in section.tables:
            if keys[table.key] > 1:  # of several evaluations
                table = replace(table, key=f"{table.key}-{number}", title=f"{table.title}: {section.title}")
            lines += ["", *latex_table(table)]
    return "\n".join(lines) + "\n"


def latex_table(table: Table) -> list[str]:
    """Return the lines of a table in the style of booktabs."""
    columns = "".join("l" if table.is_text(column) else "r" for column in range(len(table.header)))
    rows = []
    for index, row in enumerate(table.rows):
        cells = []
        for column, cell in enumerate(row):
            words = table.text(cell, r" {{\scriptsize [{}, {}]}}", latex_text)
            words = rf"\texttt{{{words}}}" if isinstance(cell, Name) else words
            strong = index in table.strong or (index, column) in table.best
            cells.append(rf"\textbf{{{words}}}" if strong and words else words)
        rows += [*[r"\midrule"] * (index in table.rules), " & ".join(cells) + r" \\"]
    caption = ". ".join(part.rstrip(".") for part in (table.title, table.note) if part)
    return [
        r"\begin{table}",
        r"\centering",
        r"\small",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{@{{}}{columns}@{{}}}}",
        r"\toprule",
        *(_latex_groups(table) if table.groups else []),
        " & ".join(latex_text(name) for name in table.header) + r" \\",
        r"\midrule",
        *rows,
        r"\bottomrule",
        r"\end{tabular}}",
        rf"\caption{{{latex_text(caption)}.}}",
        rf"\label{{tab:{table.key}}}",
        r"\end{table}",
    ]


def _latex_groups(table: Table) -> list[str]:
    cells, rules, column = [], [], 1
    for title, columns in groupby(table.groups):
        span = len([*columns])
        cells.append(rf"\multicolumn{{{span}}}{{c}}{{{latex_text(title)}}}" if title else " & " * (span - 1))
        if title:
            rules.append(rf"\cmidrule(lr){{{column}-{column + span - 1}}}")
        column += span
    return [" & ".join(cells) + r" \\", " ".join(rules)]


# --- the terminal ---

WIDTH = 140
"""Columns of a report that is written to a file."""
MOST_COLUMNS = 15
"""Columns of a table with groups that fit into a terminal."""


def terminal(report: Report) -> RenderableType:
    """Return a report for the terminal: its title, then the sections."""
    parts: list[RenderableType] = [Text(report.title, style="bold")]
    for section in report.sections:
        if section.title:
            parts.append(Text(f"\n{section.title}", style="bold underline"))
        parts += [terminal_table(part) for table in section.tables for part in _in_parts(table)]
        parts += [Text(sentence) for sentence in section.sentences]
        parts += [Text(f"note: {note}") for note in section.notes]
    return Group(*parts)


def to_text(report: Report) -> str:
    """Return the terminal's output as text for a file."""
    out = io.StringIO()
    Console(file=out, width=WIDTH, highlight=False, markup=False).print(terminal(report), crop=False)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()).strip("\n") + "\n"


INDENT = 2
PLAIN = Console(width=10_000, markup=False, highlight=False)  # measures texts that no edge breaks


class Unbroken:
    """A table in which no name is broken: to be printed with ``crop=False``.

    In a terminal that is too narrow, each name has a line of its own, over its row. ``table`` must not change any more;
    ``column`` is that of the names.
    """

    def __init__(self, table: RichTable, column: int = 0) -> None:
        self.table, self.column = table, column
        names = table.columns[column]
        names.no_wrap, names.overflow = True, "ignore"
        widths = [Measurement.get(PLAIN, PLAIN.options, cell).maximum for cell in names.cells]
        names.min_width = max(widths, default=1)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        needed = Measurement.get(PLAIN, PLAIN.options, self.table)
        if needed.minimum <= options.max_width:
            yield self.table
        elif not console.is_terminal:
            yield from console.render(self.table, options.update(width=needed.maximum))
        else:
            yield from self._under_names(options.max_width)

    def _under_names(self, room: int) -> RenderResult:
        columns = self.table.columns
        after = columns[self.column + 1 :]
        wished = [[Measurement.get(PLAIN, PLAIN.options, cell) for cell in (c.header, *c.cells)] for c in after]
        least, most = ([max(size[end] for size in sizes) for sizes in wished] for end in (0, 1))
        space = room - INDENT * len(after)
        last = min(most[-1], space - sum(most[:-1]))  # text at the end of a row takes the remaining width
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
        for cells in zip(*(column.cells for column in columns), strict=True):
            names = [cell if isinstance(cell, Text) else Text(str(cell)) for cell in cells[: self.column + 1]]
            yield Text(" ", no_wrap=True, overflow="ignore").join(names)
            yield row(cells[self.column + 1 :])
        if self.table.caption:
            yield Text(str(self.table.caption))


def terminal_table(table: Table) -> RichTable | Unbroken:
    """Return a table for the terminal; an interval goes to a line of its own where it is narrow."""
    result = RichTable(
        title=table.title or None, title_justify="left", header_style="bold", pad_edge=False, box=box.SIMPLE_HEAD
    )
    for column, (title, name) in enumerate(zip(table.titles, table.header, strict=True)):
        # Rates are so narrow that the title of a long group does not fit over them.
        short = title.removeprefix("libero_")
        short = short if len(short) <= 4 else f"{short[:4]}."
        header = f"{short}\n{name}" if title else name
        result.add_column(header, justify="left" if table.is_text(column) else "right", overflow="fold")
    for index, row in enumerate(table.rows):
        if index in table.rules:
            result.add_section()
        cells = []
        for column, cell in enumerate(row):
            best, whole = (index, column) in table.best, isinstance(cell, Name)
            style = "bold" if best or index in table.strong else ""
            overflow: OverflowMethod | None = "ignore" if whole else None
            cells.append(Text(table.text(cell) + "*" * best, style=style, no_wrap=whole or None, overflow=overflow))
        result.add_row(*cells)
    if table.best:
        result.caption = "* best of its column"
        result.caption_justify = "left"
    names_at = next((k for k in range(len(table.header)) if any(isinstance(row[k], Name) for row in table.rows)), None)
    return result if names_at is None else Unbroken(result, names_at)


def _in_parts(table: Table) -> list[Table]:
    """Cut a table with groups of columns into several that fit; each keeps the columns before the first group."""
    titles = table.titles
    leading = [column for column, title in enumerate(titles) if not title]
    parts: list[list[int]] = [[]]
    for _, group in groupby([column for column, title in enumerate(titles) if title], titles.__getitem__):
        columns = list(group)
        wished = [*leading, *parts[-1], *columns]
        if parts[-1] and (len(wished) > MOST_COLUMNS or sum(_least_width(table, k) for k in wished) > WIDTH):
            parts.append([])
        parts[-1] += columns
    if len(parts) == 1:
        return [table]
    return [
        replace(
            table,
            title=table.title if k == 0 else f"{table.title}, continued",
            header=[table.header[column] for column in chosen],
            rows=[[row[column] for column in chosen] for row in table.rows],
            groups=[titles[column] for column in chosen],
        )
        for k, part in enumerate(parts)
        for chosen in [[*leading, *part]]
    ]


def _least_width(table: Table, column: int) -> int:
    cells = [row[column] for row in table.rows]
    texts = [table.text(cell) for cell in cells]
    if not any(isinstance(cell, Name) for cell in cells):  # other texts are broken between words
        texts = [word for text in texts for word in text.split()]
    return max(map(len, [*table.header[column].split(), *texts]), default=0) + 2


# --- JSON, CSV, and all formats ---

WRITERS: Mapping[str, Callable[[Report], str]] = {
    "table": to_text,
    "markdown": to_markdown,
    "latex": to_latex,
    "json": lambda report: json.dumps(report.data, indent=2) + "\n",
}
"""Format -> its writer; `csv_tables` writes one file per table."""


def csv_tables(report: Report) -> dict[str, str]:
    """Return key -> table as CSV, for every table of a report; those of several evaluations under one another."""
    keys = Counter(table.key for table in report.tables)
    rows: dict[str, list[dict[str, object]]] = {}
    for section in report.sections:
        for table in section.tables:
            evaluation = {"evaluation": section.title} if keys[table.key] > 1 else {}
            rows.setdefault(table.key, []).extend({**evaluation, **row} for row in _csv_rows(table))
    return {key: csv_text(members) for key, members in rows.items()}


def _csv_rows(table: Table) -> list[dict[str, object]]:
    """Return a table's rows as column -> value: rates in per cent, each followed by the bounds of its interval."""
    rates = {c for row in table.rows for c, cell in enumerate(row) if isinstance(cell, Rate)}
    rows = []
    for row in table.rows:
        values: dict[str, object] = {}
        for column, (name, cell) in enumerate(zip(table.names, row, strict=True)):
            if isinstance(cell, PrefixRates):
                values |= {f"{name} {order.replace('_', ' ')}": percent(r.value) for order, r in cell._asdict().items()}
            elif column in rates:  # its bounds are columns where no rate applies, too
                rate = cell if isinstance(cell, Rate) else Rate(None, 0)
                low, high = rate.interval or (None, None)
                values |= {name: percent(rate.value), f"{name} low": percent(low), f"{name} high": percent(high)}
            elif cell != "":
                values[name] = cell
        rows.append(values)
    return rows


def csv_text(rows: Sequence[Mapping[str, object]]) -> str:
    """Return rows, column -> value, as CSV (RFC 4180, but lines end in a plain line feed); None is an empty field."""

    def escaped(value: object) -> object:
        # A spreadsheet would run names in logs of strangers as formulas.
        formula = isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r"))
        return f"'{value}" if formula else value

    out = io.StringIO()
    header = {name: escaped(name) for row in rows for name in row}
    writer = csv.DictWriter(out, header, lineterminator="\n")
    writer.writerows({name: escaped(value) for name, value in row.items()} for row in (header, *rows))
    return out.getvalue()
