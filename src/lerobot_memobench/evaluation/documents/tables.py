"""Tables of a report, whatever they are written as; ``formats`` writes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from lerobot_memobench.evaluation.metrics.rates import Rate, percent

NOT_APPLICABLE = "–"

OPERATION_NAMES = {"S": "Storage", "U": "Update", "C": "Compression"}


class Name(str):
    """Text that is an identifier, such as a task's name: Markdown and LaTeX set it in typewriter."""


class Numbers(str):
    """Figures written out; set flush right like figures."""


class Count(int):
    """A number of things; other integers are labels."""


Cell = Rate | str | int | None
"""A rate (per cent, with its interval where it has one), text, a number; None where nothing applies."""


@dataclass(frozen=True)
class Table:
    """A table and what is said under it.

    Attributes:
        key: short name, unique in a report. header: names of the columns.
        rows: each as long as the header. note: how to read it.
        groups: (title, columns) over the header, from the left; "" for none.
        strong: rows that sum up, by index. rules: rows before which a line is drawn.
        best: (row, column) of the cells to be marked as best.
        intervals: whether rates are followed by their interval.
    """

    key: str
    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]
    note: str = ""
    groups: tuple[tuple[str, int], ...] = ()
    strong: frozenset[int] = frozenset()
    rules: frozenset[int] = frozenset()
    best: frozenset[tuple[int, int]] = frozenset()
    intervals: bool = True

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.header):
                raise ValueError(f"a row of the table {self.key!r} has {len(row)} cells for {len(self.header)} columns")

    @property
    def titles(self) -> list[str]:
        """The title of the group over each column, "" for none."""
        return [title for title, span in self.groups for _ in range(span)] or [""] * len(self.header)

    def is_text(self, column: int) -> bool:
        """Return whether a column holds text and is therefore set flush left."""
        return any(isinstance(row[column], str) and not isinstance(row[column], Numbers) for row in self.rows)


@dataclass(frozen=True)
class Section:
    """Tables and sentences under one heading."""

    title: str
    tables: tuple[Table, ...] = ()
    sentences: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Report:
    """A report: sections, and the same figures as JSON values."""

    title: str
    sections: tuple[Section, ...]
    data: Mapping[str, object] = field(default_factory=dict)

    @property
    def tables(self) -> list[Table]:
        """The tables of all sections."""
        return [table for section in self.sections for table in section.tables]


def figure(value: float | None) -> str:
    """Return a fraction as a percentage with one decimal."""
    found = percent(value)
    return NOT_APPLICABLE if found is None else f"{found:.1f}"


def plain(cell: Cell) -> str:
    """Return a cell that is no rate as text."""
    return NOT_APPLICABLE if cell is None else str(cell)


def bounds(rate: Rate) -> tuple[str, str] | None:
    """Return the interval of a rate in per cent, None where it has none."""
    interval = rate.interval if rate.trials else None
    return None if interval is None else (figure(interval[0]), figure(interval[1]))


def best_in_columns(rows: tuple[tuple[Cell, ...], ...]) -> frozenset[tuple[int, int]]:
    """Return the cells that hold the highest rate of their column, all of them where they tie as printed."""
    found = set()
    for column in range(len(rows[0]) if rows else 0):
        rates = {k: row[column] for k, row in enumerate(rows) if isinstance(row[column], Rate)}
        printed = {k: percent(rate.value) for k, rate in rates.items() if isinstance(rate, Rate)}
        known = [value for value in printed.values() if value is not None]
        if len(printed) > 1 and known:
            found |= {(k, column) for k, value in printed.items() if value == max(known)}
    return frozenset(found)
