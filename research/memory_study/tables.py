"""Tables of the study: what each row solves and satisfies, follows and loses, and how it differs from a reference."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

from lerobot_memobench.evaluation.metrics import METRICS
from lerobot_memobench.evaluation.records import read_rollouts
from lerobot_memobench.io import read_json
from lerobot_memobench.tasks.task import MEMORY_TYPES
from research.learning.results import contrasts, contrasts_table, markdown
from research.learning.stages import ended
from research.memory_study.cells import ROLLOUTS, Cell
from research.memory_study.grid import Grid

REFERENCES = ("no memory", "clock only")
"""Rows from which the others' differences are told."""
EVIDENCE, PAUSES = "evidence", "pauses"
EMPTY = "–"


def tables(grid: Grid, out: Path, suite: str) -> str:
    """Return the Markdown of a suite: its rows, and their differences from the references; "" where none is evaluated.

    A row counts as soon as one of its training seeds has been evaluated; the table says how many have.
    """
    there = _evaluated_rows(grid, out, suite)
    if not there:
        return ""
    parts = [f"## {suite}", markdown(_header(), [_line(grid, row, own) for row, own in there.items()])]
    for reference in REFERENCES:
        if reference in there:
            parts.append(f"Less *{reference}*, by the training seeds that both have:")
            parts.append(_differences(there, reference))
    return "\n\n".join(parts)


def figures_of_rows(grid: Grid, out: Path, suite: str) -> dict[str, dict[str, Any]]:
    """Return row -> SR ("solved") and rate of "follows" of each training seed, and the chance of it; per cent."""
    found = {}
    for row, cells in _evaluated_rows(grid, out, suite).items():
        evidence = _evidence(cells)
        found[row] = {
            "solved": [_report(cell, ROLLOUTS)["average"]["SR"] for cell in cells],
            "follows": [told["follows"] for told in evidence],
            "chance": evidence[0]["chance"] if evidence else None,
        }
    return found


def _evaluated_rows(grid: Grid, out: Path, suite: str) -> dict[str, list[Cell]]:
    cells = {
        row: [cell for seed in range(told.seeds) if evaluated(cell := Cell(grid, out, suite, row, seed), ROLLOUTS)]
        for row, told in grid.rows.items()
    }
    return {row: own for row, own in cells.items() if own}


def _evidence(cells: Sequence[Cell]) -> list[dict[str, float]]:
    """Return "follows" and "chance" of each training seed, per cent; [] where no task tells a chance."""
    reports = [_report(cell, EVIDENCE).get("evidence") for cell in cells if evaluated(cell, EVIDENCE)]
    averages = [told["average"] for told in reports if told and told["average"]]
    return [{"follows": one["follows"]["percent"], "chance": one["chance"]} for one in averages]


def evaluated(cell: Cell, part: str) -> bool:
    """Return whether a cell's evaluation, or a control, is done."""
    return part in cell.parts and ended(cell.folder / f"{part}.log")


def _header() -> list[str]:
    return [
        *("", "training seeds", *MEMORY_TYPES, "SR", "of seeds", *METRICS[1:]),
        *("follows evidence (chance)", "SR in pauses"),
    ]


def _line(grid: Grid, row: str, cells: Sequence[Cell]) -> list[str]:
    reports = [_report(cell, ROLLOUTS) for cell in cells]
    follows = _evidence(cells)
    paused = [_report(cell, PAUSES) for cell in cells if evaluated(cell, PAUSES)]
    return [
        row + (" (privileged)" if grid.rows[row].privileged else ""),
        str(len(cells)),
        *(_mean([(report["memory_types"].get(kind) or {}).get("SR") for report in reports]) for kind in MEMORY_TYPES),
        f"**{_mean([report['average']['SR'] for report in reports])}**",
        ", ".join(f"{report['average']['SR']:.0f}" for report in reports),
        *(_mean([report["average"][metric] for report in reports]) for metric in METRICS[1:]),
        f"{_mean([one['follows'] for one in follows])} ({_mean([one['chance'] for one in follows])})"
        if follows
        else EMPTY,
        _mean([report["average"]["SR"] for report in paused]) if paused else EMPTY,
    ]


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{mean(known):.1f}" if known else EMPTY


def _report(cell: Cell, part: str) -> dict[str, Any]:
    return read_json(cell.evaluation(part) / "report.json", dict[str, Any], "evaluate the cell again")


def _differences(cells: Mapping[str, Sequence[Cell]], reference: str) -> str:
    """Return a table of each row against a reference; rows with as many training seeds are adjusted together."""
    groups: dict[tuple[int, ...], list[str]] = {}
    base = {cell.seed: cell for cell in cells[reference]}
    for row, own in cells.items():
        shared = tuple(cell.seed for cell in own if cell.seed in base)
        if row != reference and shared:
            groups.setdefault(shared, []).append(row)
    found = []
    for seeds, rows in sorted(groups.items(), key=lambda group: -len(group[0])):
        arms = {
            row: [read_rollouts(cell.evaluation(ROLLOUTS))[0] for cell in cells[row] if cell.seed in seeds]
            for row in (reference, *rows)
        }
        found.append(contrasts_table(contrasts(arms, reference), len(seeds), reference))
    return "\n\n".join(found)
