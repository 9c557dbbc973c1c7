"""Do annotators agree on which operation a checkpoint is? Figures of a relabelling study (paper, appendix).

Labels are "S", "U", "C". A template is one checkpoint; every rater labels every template. The sheet has one row per
template. Columns: ``template``, or ``task`` and ``checkpoint`` (counted from 1); ``released``, which may be left out
where task and checkpoint name one of the catalogue; ``memory_type``, ``language``, ``predicate`` and ``notes``, which
are for people; every other column is a rater.
"""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Rate
from lerobot_memobench.evaluation.tables import (
    NOT_APPLICABLE,
    OPERATION_NAMES,
    Cell,
    Count,
    Numbers,
    Report,
    Section,
    Table,
    csv_text,
)
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import format_formula
from lerobot_memobench.tasks.task import DEFAULT_LEVEL, OPERATIONS

# --- agreement beyond chance: kappa, None where only one label is ever used ---


def kappa(observed: float, expected: float) -> float | None:
    """Return (observed − expected) / (1 − expected)."""
    return None if expected >= 1.0 else (observed - expected) / (1.0 - expected)


def fleiss_kappa(rows: Sequence[Sequence[str]]) -> float | None:
    """Return Fleiss' kappa of (T, R) labels, R ≥ 2 (Fleiss 1971)."""
    from statsmodels.stats.inter_rater import aggregate_raters, fleiss_kappa

    counts, labels = aggregate_raters(np.array([list(row) for row in rows]))
    return None if len(labels) == 1 else float(fleiss_kappa(counts))


def cohen_kappa(a: Sequence[str], b: Sequence[str]) -> float | None:
    """Return Cohen's kappa of two raters' (T,) labels (Cohen 1960)."""
    labels, counts = sorted({*a, *b}), Counter(zip(a, b, strict=True))
    return confusion_kappa([[counts[x, y] for y in labels] for x in labels])


def confusion_kappa(table: Sequence[Sequence[int]]) -> float | None:
    """Return Cohen's kappa of a square table of counts."""
    from statsmodels.stats.inter_rater import cohens_kappa

    counts = np.array(table)
    if counts.diagonal().max() == counts.sum():
        return None
    return float(cohens_kappa(counts, return_results=False))


# --- figures of a study ---


@dataclass(frozen=True)
class Labels:
    """A relabelling study.

    Attributes:
        templates: names. raters: rater -> (T,) labels. released: (T,) labels to compare with, None where unknown.
    """

    templates: tuple[str, ...]
    raters: Mapping[str, tuple[str, ...]]
    released: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if len(self.raters) < 2 or not self.templates:
            raise MemobenchError(
                f"found {len(self.raters)} raters and {len(self.templates)} templates; agreement needs two raters and "
                "a template at least"
            )

    @property
    def rows(self) -> list[tuple[str, ...]]:
        """Per template the labels of all raters."""
        return list(zip(*self.raters.values(), strict=True))


def majority(row: Sequence[str]) -> str | None:
    """Return the label that more than half of the raters gave, None where none has."""
    label, count = Counter(row).most_common(1)[0]
    return label if 2 * count > len(row) else None


def confusion(labels: Labels, released: Sequence[str]) -> dict[str, dict[str, int]]:
    """Return released label -> label given -> decisions of all raters together."""
    counts = Counter((right, given) for right, row in zip(released, labels.rows, strict=True) for given in row)
    return {right: {given: counts[right, given] for given in OPERATIONS} for right in OPERATIONS}


@dataclass(frozen=True)
class Agreement:
    """The figures of a study; counts are (agreeing, of). Those against released labels are None without them."""

    templates: int
    raters: tuple[str, ...]
    fleiss: float | None
    cohen: Mapping[tuple[str, str], float | None]
    exact: tuple[int, int]
    splits: Mapping[str, int]
    majority: tuple[int, int] | None
    pooled: tuple[int, int] | None
    per_rater: Mapping[str, tuple[int, int]] | None
    pooled_kappa: float | None
    confusion: Mapping[str, Mapping[str, int]] | None


def study(labels: Labels) -> Agreement:
    """Compute all figures of a study."""
    rows, count = labels.rows, len(labels.templates)
    splits = Counter("/".join(sorted(set(row), key=OPERATIONS.index)) for row in rows if len(set(row)) > 1)
    return Agreement(
        templates=count,
        raters=tuple(labels.raters),
        fleiss=fleiss_kappa(rows),
        cohen={(a, b): cohen_kappa(labels.raters[a], labels.raters[b]) for a, b in combinations(labels.raters, 2)},
        exact=(sum(len(set(row)) == 1 for row in rows), count),
        splits=dict(splits),
        **_against_released(labels),
    )


def _against_released(labels: Labels) -> dict[str, Any]:
    """Return the figures of `Agreement` that compare with released labels."""
    if labels.released is None:
        return dict.fromkeys(("majority", "pooled", "per_rater", "pooled_kappa", "confusion"))
    released, count = labels.released, len(labels.templates)
    right = {name: sum(x == y for x, y in zip(given, released, strict=True)) for name, given in labels.raters.items()}
    table = confusion(labels, released)
    return {
        "majority": (sum(majority(row) == label for row, label in zip(labels.rows, released, strict=True)), count),
        "pooled": (sum(right.values()), count * len(labels.raters)),
        "per_rater": {name: (n, count) for name, n in right.items()},
        "pooled_kappa": confusion_kappa([list(row.values()) for row in table.values()]),
        "confusion": table,
    }


# --- the sheet ---

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


# --- the report ---


def report(found: Agreement) -> Report:
    """Return a study's figures as tables and JSON values."""
    rows: list[tuple[Cell, ...]] = [
        (f"Fleiss' κ, {len(found.raters)} raters", _kappa_text(found.fleiss), ""),
        *((f"Cohen's κ, {a} and {b}", _kappa_text(value), "") for (a, b), value in found.cohen.items()),
        _share("all raters agree", found.exact),
        *((f"raters split between {name}", Numbers(f"{n}"), "") for name, n in sorted(found.splits.items())),
    ]
    tables = []
    if found.majority and found.pooled and found.per_rater is not None:
        rows.append(_share("majority and released labels agree", found.majority))
        rows.append(_share("raters' decisions and released labels agree", found.pooled))
        rows += [_share(f"{name} and released labels agree", share) for name, share in found.per_rater.items()]
        rows.append(("Cohen's κ, decisions and released labels", _kappa_text(found.pooled_kappa), ""))
    if found.confusion is not None:
        tables.append(confusion_table(found.confusion))
    statistics = Table(
        "agreement", f"Agreement on {found.templates} templates", ("figure", "", "per cent"), tuple(rows)
    )
    return Report("Annotation study", (Section("", (statistics, *tables)),), data(found))


def confusion_table(counts: Mapping[str, Mapping[str, int]]) -> Table:
    """Return the table of decisions by released label."""
    rows: list[tuple[Cell, ...]] = [
        (OPERATION_NAMES[label], *(Count(n) for n in row.values()), _rate(row[label], sum(row.values())))
        for label, row in counts.items()
    ]
    header = ("released label", *(f"given {name}" for name in OPERATION_NAMES), "agree")
    return Table("confusion", "Decisions of all raters by released label", header, tuple(rows))


def _rate(part: int, whole: int) -> Rate:
    return Rate(part / whole, whole) if whole else Rate(None, 0)


def _share(name: str, share: tuple[int, int]) -> tuple[Cell, ...]:
    part, whole = share
    return (name, Numbers(f"{part}/{whole}"), Numbers(f"{100 * part / whole:.1f}"))


def _kappa_text(value: float | None) -> Numbers:
    return Numbers(NOT_APPLICABLE if value is None else f"{value:.3f}".replace("-", "−"))


def data(found: Agreement) -> dict[str, Any]:
    """Return a study's figures as JSON values."""
    return {
        "templates": found.templates,
        "raters": list(found.raters),
        "fleiss_kappa": found.fleiss,
        "cohen_kappa": [{"raters": [a, b], "kappa": value} for (a, b), value in found.cohen.items()],
        "exact_agreement": _counts(found.exact),
        "splits": dict(found.splits),
        "majority_vs_released": _counts(found.majority),
        "pooled_vs_released": _counts(found.pooled),
        "per_rater_vs_released": (
            None if found.per_rater is None else {name: _counts(value) for name, value in found.per_rater.items()}
        ),
        "pooled_kappa_vs_released": found.pooled_kappa,
        "confusion": None if found.confusion is None else {label: dict(row) for label, row in found.confusion.items()},
    }


def _counts(share: tuple[int, int] | None) -> dict[str, Any] | None:
    if share is None:
        return None
    return {"agree": share[0], "of": share[1], "percent": round(100 * share[0] / share[1], 1)}
