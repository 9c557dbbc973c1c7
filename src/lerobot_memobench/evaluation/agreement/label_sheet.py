"""The sheet of an annotation study as CSV: reading one that raters have filled in, writing a blank one.

One row per template. Columns: ``template``, or ``task`` and ``checkpoint`` (counted from 1); ``released``, which may
be left out where task and checkpoint name one of the catalogue; ``memory_type``, ``language``, ``predicate`` and
``notes``, which are for people; every other column is a rater.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.agreement.study import Labels
from lerobot_memobench.evaluation.documents.formats import csv_text
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.task import DEFAULT_LEVEL

IDENTITY = ("template", "task", "checkpoint")
FOR_PEOPLE = ("memory_type", "language", "predicate", "notes")
RELEASED = "released"

SPELLINGS = {
    "s": "S", "storage": "S", "0": "S",
    "u": "U", "update": "U", "1": "U",
    "c": "C", "compression": "C", "2": "C",
}  # fmt: skip
"""What a label may be written as, in lower case; numbers are those of the published metadata."""


def read_labels(path: Path) -> Labels:
    """Read a sheet.

    Raises:
        MemobenchError: it cannot be read or is malformed; the message names file, line and column.
    """
    header, lines = _read(path)
    raters = _raters(path, header)
    names: list[str] = []
    released: list[str] = []
    given: dict[str, list[str]] = {name: [] for name in raters}
    for number, cells in lines:
        where = f"{path}, line {number}"
        if len(cells) != len(header):
            raise MemobenchError(f"{where}: found {len(cells)} columns, expected the {len(header)} of the header")
        row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
        name = _template(row, where)
        if name in names:
            raise MemobenchError(f"{where}: the template {name!r} was there before; expected one row for each")
        names.append(name)
        for rater in raters:
            given[rater].append(_label(row[rater], where, rater))
        label = _released(row, where)
        if label is not None:
            released.append(label)
    if not names:
        raise MemobenchError(f"{path} holds no templates; expected a header and a row for each")
    if released and len(released) != len(names):
        raise MemobenchError(f"{path}: only {len(released)} of {len(names)} rows have a released label; expected all")
    return Labels(
        tuple(names), {name: tuple(labels) for name, labels in given.items()}, tuple(released) if released else None
    )


def _read(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Return the header of a CSV file and its rows that are not empty, each with the number of its line."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror or error})") from None
    except UnicodeDecodeError as error:
        raise MemobenchError(f"{path} is not UTF-8 at byte {error.start}; save it as CSV in UTF-8") from None
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        lines = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except csv.Error as error:
        raise MemobenchError(f"{path}, line {reader.line_num}: {error}; expected comma-separated values") from None
    return header, lines


def _raters(path: Path, header: list[str]) -> list[str]:
    """Check the header and return the columns of raters."""
    where = f"{path}, line 1"
    if not header or header == [""]:
        raise MemobenchError(f"{path} is empty; expected a header such as template,released,rater_1,rater_2,rater_3")
    for column, name in enumerate(header, start=1):
        if not name:
            raise MemobenchError(f"{where}: column {column} has no name; name it after its rater, or remove it")
        if header.count(name) > 1:
            raise MemobenchError(f"{where}: there are two columns {name!r}; expected one of each")
    if "template" not in header and not {"task", "checkpoint"} <= set(header):
        raise MemobenchError(f"{where}: found neither a column template nor the columns task and checkpoint")
    raters = [name for name in header if name not in (*IDENTITY, RELEASED, *FOR_PEOPLE)]
    if len(raters) < 2:
        found = ", ".join(raters) or "none"
        raise MemobenchError(f"{where}: found {found} as columns of raters; expected two at least")
    return raters


def _template(row: Mapping[str, str], where: str) -> str:
    if "template" in row:
        if not row["template"]:
            raise MemobenchError(f"{where}, column template: is empty; expected the template's name")
        return row["template"]
    for column in ("task", "checkpoint"):
        if not row[column]:
            raise MemobenchError(f"{where}, column {column}: is empty")
    return f"{row['task']}, checkpoint {row['checkpoint']}"


def _label(text: str, where: str, column: str) -> str:
    label = SPELLINGS.get(text.lower())
    if label is None:
        found = "is empty" if not text else f"found {text!r}"
        raise MemobenchError(f"{where}, column {column}: {found}; expected S, U or C (Storage, Update, Compression)")
    return label


def _released(row: Mapping[str, str], where: str) -> str | None:
    """Return the released label: the sheet's, else that of the catalogue's checkpoint, None where neither is known."""
    if RELEASED in row:
        return _label(row[RELEASED], where, RELEASED)
    if not {"task", "checkpoint"} <= set(row):
        return None
    if row["task"] not in task_names(suite=None):
        try:
            get_task(row["task"])
        except MemobenchError as error:
            raise MemobenchError(f"{where}, column task: {error}, or add a column {RELEASED}") from None
    operations = get_task(row["task"]).operations
    number = row["checkpoint"]
    if not number.isascii() or not number.isdigit() or not 1 <= int(number) <= len(operations):
        raise MemobenchError(
            f"{where}, column checkpoint: found {number!r}; {row['task']!r} has the checkpoints 1 to {len(operations)}"
        )
    return operations[int(number) - 1]


def blank_sheet(raters: int = 3) -> str:
    """Return the sheet of the catalogue's 84 templates for a new study, as CSV; it does not show released labels."""
    columns = [f"rater_{k + 1}" for k in range(raters)]
    rows = []
    for name in task_names():
        task = get_task(name)
        for k, checkpoint in enumerate(task.checkpoints, start=1):
            text, predicate = checkpoint.language[DEFAULT_LEVEL], format_formula(checkpoint.goal)
            rows.append((name, k, task.memory_type, text, predicate, *[""] * raters))
    return csv_text(rows, ("task", "checkpoint", "memory_type", "language", "predicate", *columns))
