"""Tables of the study: what each row solves and satisfies, follows and loses, and how it differs from a reference."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from lerobot_memobench.evaluation.metrics import METRICS, Record, report_values
from lerobot_memobench.evaluation.records import read_rollouts, read_runs
from lerobot_memobench.evaluation.report import control_data
from lerobot_memobench.evaluation.statistics import Estimate
from lerobot_memobench.tasks.task import MEMORY_TYPES
from research.learning.results import average_success, contrasts, contrasts_table, markdown
from research.learning.stages import ended
from research.memory_study.cells import ROLLOUTS, SEALED, TRAINING, Cell, after
from research.memory_study.grid import Grid

REFERENCES = ("no memory", "clock only", "frames")
"""Rows from which the others' differences are told."""
EVIDENCE, PAUSES = "evidence", "pauses"
OWN_COLUMNS = (EVIDENCE, PAUSES)
"""Controls that stand beside the rows; the others have a table of their own."""
EMPTY = "–"

Rows = Mapping[str, Sequence[Cell]]
"""Row -> its cells that have been evaluated, in the order of training seeds."""


def tables(grid: Grid, out: Path, suite: str) -> str:
    """Return the Markdown of a suite's rows; "" where none is evaluated.

    A row counts as soon as one of its training seeds has been evaluated; the table says how many have.
    """
    rows = evaluated_rows(grid, out, suite)
    if not rows:
        return ""
    parts = [
        ("What is solved, and whether it follows the evidence", _summary(grid, rows)),
        ("Rates by memory type and operation", _by_memory_type(rows)),
        ("Success by task", _by_task(rows, grid.suites[suite].ceilings)),
        ("How rollouts ended, all training seeds together", _endings(rows)),
        ("Other conditions of the rollouts, first training seed", _conditions(rows)),
        ("Success and satisfied checkpoints by updates", _by_updates(grid, rows)),
        *((f"Less *{name}*, by the training seeds that both have", _differences(rows, name)) for name in REFERENCES),
        ("The sealed test", _sealed(rows)),
        ("What a cell takes", _costs(rows)),
    ]
    return "\n\n".join([f"## {suite}", *(f"### {title}\n\n{table}" for title, table in parts if table)])


def figures_of_rows(grid: Grid, out: Path, suite: str) -> dict[str, dict[str, Any]]:
    """Return row -> SR ("solved") and rate of "follows" of each training seed, and the chance of it; per cent."""
    found = {}
    for row, cells in evaluated_rows(grid, out, suite).items():
        evidence = _evidence(cells)
        found[row] = {
            "solved": [report(cell, ROLLOUTS)["average"]["SR"] for cell in cells],
            "follows": [told["follows"] for told in evidence],
            "chance": evidence[0]["chance"] if evidence else None,
        }
    return found


# -- what there is ----------------------------------------------------------------------------------------------------


def evaluated_rows(grid: Grid, out: Path, suite: str) -> dict[str, list[Cell]]:
    """Return the rows of a suite of which a training seed is evaluated."""
    cells = {
        row: [cell for seed in range(told.seeds) if evaluated(cell := Cell(grid, out, suite, row, seed), ROLLOUTS)]
        for row, told in grid.rows.items()
    }
    return {row: own for row, own in cells.items() if own}


def evaluated(cell: Cell, part: str) -> bool:
    """Return whether a cell's evaluation, or a control, is done."""
    return part in cell.parts and ended(cell.log(part))


def report(cell: Cell, part: str) -> dict[str, Any]:
    """Return the figures of an evaluation, counted from its log."""
    return _figures(cell.evaluation(part))


@cache
def _figures(folder: Path) -> dict[str, Any]:
    (run,) = read_runs([folder])
    return {**report_values(run.summary), **control_data(run)}


def named_rollouts(grid: Grid, out: Path, suite: str) -> list[tuple[str, Path]]:
    """Return name and folder of every evaluation of a suite's rows, as a report tells them apart."""
    rows = evaluated_rows(grid, out, suite)
    return [(f"{row}, seed {cell.seed}", cell.evaluation(ROLLOUTS)) for row, cells in rows.items() for cell in cells]


@cache
def _rollouts(folder: Path) -> list[Record]:
    return list(read_rollouts(folder)[0])


def _runs(cells: Sequence[Cell], part: str = ROLLOUTS) -> list[list[Record]]:
    return [_rollouts(cell.evaluation(part)) for cell in cells]


def _evidence(cells: Sequence[Cell]) -> list[dict[str, float]]:
    """Return "follows" and "chance" of each training seed, per cent; [] where no task tells a chance."""
    reports = [report(cell, EVIDENCE).get("evidence") for cell in cells if evaluated(cell, EVIDENCE)]
    averages = [told["average"] for told in reports if told and told["average"]]
    return [{"follows": one["follows"]["percent"], "chance": one["chance"]} for one in averages]


# -- tables -----------------------------------------------------------------------------------------------------------


def _summary(grid: Grid, rows: Rows) -> str:
    header = ("", "training seeds", "SR", "95 %", "of seeds", *METRICS[1:], "follows evidence (chance)", "SR in pauses")
    return markdown(header, [_summary_line(grid, row, cells) for row, cells in rows.items()])


def _summary_line(grid: Grid, row: str, cells: Sequence[Cell]) -> list[str]:
    reports = [report(cell, ROLLOUTS) for cell in cells]
    follows = _evidence(cells)
    paused = [report(cell, PAUSES) for cell in cells if evaluated(cell, PAUSES)]
    chance = f"{_mean([one['follows'] for one in follows])} ({_mean([one['chance'] for one in follows])})"
    return [
        row + (" (privileged)" if grid.rows[row].privileged else ""),
        str(len(cells)),
        *_with_interval(average_success(_runs(cells))),
        ", ".join(f"{report['average']['SR']:.0f}" for report in reports),
        *(_average(reports, metric) for metric in METRICS[1:]),
        chance if follows else EMPTY,
        _average(paused, "SR"),
    ]


def _by_memory_type(rows: Rows) -> str:
    """Return the table as the paper's: four rates of each memory type."""
    header = ("", *(f"{kind} {metric}" for kind in MEMORY_TYPES for metric in METRICS))
    lines = []
    for row, cells in rows.items():
        types = [report(cell, ROLLOUTS)["memory_types"] for cell in cells]
        rates = [
            _mean([(one.get(kind) or {}).get(metric) for one in types]) for kind in MEMORY_TYPES for metric in METRICS
        ]
        lines.append([row, *rates])
    return markdown(header, lines)


def _by_task(rows: Rows, ceilings: Mapping[str, float]) -> str:
    found = {row: [report(cell, ROLLOUTS)["tasks"] for cell in cells] for row, cells in rows.items()}
    names = list(next(iter(found.values()))[0])
    lines = [
        [
            f"`{name}`",
            f"{ceilings[name]:.1f}" if name in ceilings else EMPTY,
            *(_mean([one[name]["SR"] for one in own if name in one]) for own in found.values()),
        ]
        for name in names
    ]
    return markdown(("", "best found without a memory", *rows), lines)


def _endings(rows: Rows) -> str:
    counts = {row: Counter[str]() for row in rows}
    for row, cells in rows.items():
        for one in (report(cell, ROLLOUTS) for cell in cells):
            counts[row].update(success=one["average"]["n"] - sum(one["failures"].values()), **one["failures"])
    classes = list(dict.fromkeys(name for count in counts.values() for name in count))
    lines = [[name.replace("_", " "), *(str(counts[row][name]) for row in rows)] for name in classes]
    return markdown(("", *rows), lines)


def _conditions(rows: Rows) -> str:
    """Return SR in each control that has no column beside the rows."""
    first = {row: cells[0] for row, cells in rows.items() if cells[0].seed == 0}
    parts = dict.fromkeys(part for cell in first.values() for part in cell.grid.rows[cell.row].controls)
    wanted = [part for part in parts if part not in OWN_COLUMNS]
    there = {row: [part for part in wanted if evaluated(cell, part)] for row, cell in first.items()}
    lines = [
        [row, _average([report(first[row], ROLLOUTS)], "SR")]
        + [_average([report(first[row], part)], "SR") if part in own else EMPTY for part in wanted]
        for row, own in there.items()
        if own
    ]
    return markdown(("", "as it is", *wanted), lines) if lines else ""


def curves(grid: Grid, rows: Rows) -> dict[str, list[tuple[int, list[dict[str, float | None]]]]]:
    """Return row -> updates and the averages of each training seed then, of the rows with earlier checkpoints."""
    found = {}
    for row, cells in rows.items():
        points = []
        for updates in grid.rows[row].after:
            told = [report(cell, part)["average"] for cell in cells if evaluated(cell, part := after(updates))]
            points += [(updates, told)] if told else []
        if points:
            whole = int(_word(cells[0].training_words(), "steps"))
            found[row] = [*points, (whole, [report(cell, ROLLOUTS)["average"] for cell in cells])]
    return found


def _by_updates(grid: Grid, rows: Rows) -> str:
    lines = [
        [row, str(updates), str(len(told)), *(_mean([one[metric] for one in told]) for metric in METRICS)]
        for row, points in curves(grid, rows).items()
        for updates, told in points
    ]
    return markdown(("", "updates", "training seeds", *METRICS), lines) if lines else ""


def _sealed(rows: Rows) -> str:
    lines = []
    for row, cells in rows.items():
        if tested := [cell for cell in cells if evaluated(cell, SEALED)]:
            success = average_success(_runs(tested, SEALED))
            reports = [report(cell, SEALED) for cell in tested]
            averages = [_average(reports, metric) for metric in METRICS[1:]]
            lines.append([row, str(len(tested)), *_with_interval(success), *averages])
    return markdown(("", "training seeds", "SR", "95 %", *METRICS[1:]), lines) if lines else ""


def _differences(rows: Rows, reference: str) -> str:
    """Return a table of each row against a reference; rows with as many training seeds are adjusted together."""
    base = {cell.seed for cell in rows.get(reference, ())}
    groups: dict[tuple[int, ...], list[str]] = {}
    for row, own in rows.items():
        shared = tuple(cell.seed for cell in own if cell.seed in base)
        if row != reference and shared:
            groups.setdefault(shared, []).append(row)
    found = []
    for seeds, names in sorted(groups.items(), key=lambda group: -len(group[0])):
        arms = {name: _runs([cell for cell in rows[name] if cell.seed in seeds]) for name in (reference, *names)}
        found.append(contrasts_table(contrasts(arms, reference), len(seeds), reference))
    return "\n\n".join(found)


def _costs(rows: Rows) -> str:
    """Return what a training took on the clock, beside other work, and a control step of a rollout, all included."""
    lines = []
    for row, cells in rows.items():
        trained = [cost[TRAINING].wall_s / 60 for cell in cells if TRAINING in (cost := cell.costs())]
        runs = _runs(cells)
        lines.append(
            [row, _mean(trained), _mean([1000 * sum(one["wall_s"] for one in run) / _steps(run) for run in runs])]
        )
    return markdown(("", "training, min", "a control step, ms"), lines)


def _steps(records: Sequence[Record]) -> int:
    return sum(int(record["steps"]) + int(record["prompt_steps"] or 0) for record in records)


def _with_interval(success: Estimate) -> tuple[str, str]:
    assert None not in (success.value, success.low, success.high)
    value, low, high = (100 * (one or 0.0) for one in (success.value, success.low, success.high))
    return f"**{value:.1f}**", f"{low:.1f}–{high:.1f}"


def _average(reports: Sequence[Mapping[str, Any]], metric: str) -> str:
    return _mean([one["average"][metric] for one in reports])


def _mean(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    return f"{mean(known):.1f}" if known else EMPTY


def _word(words: Sequence[str], name: str) -> str:
    return next(word.partition("=")[2] for word in words if word.startswith(f"{name}="))
