"""Tables of the study: rates and evidence of each row, controls, and differences from references."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from statistics import mean
from typing import Any

from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.metrics import PAPER_METRICS, PROCESS_METRICS, Rate, Record
from lerobot_memobench.evaluation.records import read_run, read_runs
from lerobot_memobench.evaluation.report import evidence_values
from lerobot_memobench.evaluation.statistics import Estimate
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import MEMORY_TYPES
from research.memory_study.cells import Cell, difference
from research.memory_study.contrasts import SeedContrast, adjusted, average_success, contrast, episodes_of
from research.memory_study.grid import ROLLOUTS, SEALED, TRAINING, Grid

EVIDENCE = "evidence"
"""The control with columns in the first table; the others have a table of their own."""
CEILING = "ceiling without a memory"
EMPTY = "–"

Rows = Mapping[str, Sequence[Cell]]
"""Name of a row -> its evaluated cells, in the order of training seeds."""


def tables(grid: Grid, out: Path, suite: str) -> str:
    """Return the Markdown of a suite's rows; "" where none is evaluated.

    A row is shown as soon as one of its training seeds has been evaluated, with their number.
    """
    rows = evaluated_rows(grid, out, suite)
    if not rows:
        return ""
    _check_policies(rows)
    parts = [
        ("Success, and choices that follow the evidence", _summary(rows, grid.suites[suite].ceilings)),
        ("Rates by memory type and operation", _by_memory_type(rows)),
        ("Success by task", _by_task(rows, grid.suites[suite].ceilings)),
        ("How rollouts ended, all training seeds together", _endings(rows)),
        ("Other conditions of the rollouts, last training seed", _conditions(rows)),
        *_differences(grid, rows, ROLLOUTS),
        (f"Minus *{CEILING}*", _above_ceiling(rows, grid.suites[suite].ceilings)),
        ("The sealed test", _sealed(rows)),
        *_differences(grid, rows, SEALED),
        ("Cost of a cell, on a shared machine", _costs(rows)),
    ]
    return "\n\n".join([f"## {suite}", *(f"### {title}\n\n{table}" for title, table in parts if table)])


def figures_of_rows(grid: Grid, out: Path, suite: str) -> dict[str, dict[str, Any]]:
    """Return name of a row -> "solved" (SR) and "follows" per training seed, and "without" a memory, per cent."""
    found, ceiling = {}, _ceiling(grid.suites[suite].ceilings)
    for row, cells in evaluated_rows(grid, out, suite).items():
        evidence = _evidence(cells)
        found[row] = {
            "solved": [report(cell, ROLLOUTS)["average"]["SR"] for cell in cells],
            "follows": [each["follows"]["percent"] for each in evidence],
            "without": ceiling,
        }
    return found


# -- evaluated cells --------------------------------------------------------------------------------------------------


def evaluated_rows(grid: Grid, out: Path, suite: str) -> dict[str, list[Cell]]:
    """Return name -> evaluated cells of the rows of a suite."""
    found: dict[str, list[Cell]] = {}
    for name, row in grid.rows.items():
        for cell in (Cell(grid, out, suite, name, seed) for seed in range(row.seeds)):
            trained = cell.done(TRAINING)  # once, for all its evaluations
            if evaluated(cell, ROLLOUTS):
                if not trained:
                    raise MemobenchError(
                        f"{cell.evaluation(ROLLOUTS)} is of a training that has not ended by "
                        f"{cell.log(TRAINING).with_suffix('.json')}; restore that file, or remove {cell.folder}"
                    )
                found.setdefault(name, []).append(cell)
    return found


def evaluated(cell: Cell, part: str) -> bool:
    """Return whether a cell's evaluation, or a control, is done."""
    command, folder = cell.log(part).with_suffix(".json"), cell.evaluation(part)
    if folder.is_dir() and not command.exists():
        raise MemobenchError(f"{folder} exists, but {command} with its command is missing; remove the folder")
    return part in cell.parts and cell.done(part)


def _check_policies(rows: Rows) -> None:
    """Refuse a cell whose evaluations are of two policies, by the hash of their weights in the logs."""
    for cell in (cell for cells in rows.values() for cell in cells):
        folders = [cell.evaluation(part) for part in cell.parts if evaluated(cell, part)]
        found = {line["policy"]: folder for folder in folders for line in _rollouts(folder) if line.get("policy")}
        if len(found) > 1:
            both = " and ".join(map(str, found.values()))
            raise MemobenchError(f"{both} are of two policies; remove the older one's and run it again")


def report(cell: Cell, part: str) -> dict[str, Any]:
    """Return the figures of an evaluation, counted from its log."""
    return _figures(cell.evaluation(part), tuple(cell.carded_words(part)))


@cache
def _figures(folder: Path, words: Sequence[str]) -> dict[str, Any]:
    (run,) = read_runs([folder])
    for start in run.card.get("runs") or [{}]:
        differ = difference((word for word in start.get("command", ()) if word != "resume=true"), words)
        if differ is not None:
            raise MemobenchError(
                f"{folder} is of another evaluation than its cell's: only one of their commands has {differ[:80]!r}; "
                "remove the folder and evaluate the cell again"
            )
    asked, there = len(run.protocol["tasks"]) * run.protocol["episodes"], len(run.records)
    if there != asked:
        raise MemobenchError(
            f"{folder} holds {count_of(there, 'rollout')} of the {asked} that its card asks for; remove "
            f"{folder}.json and evaluate it again"
        )
    summary = run.summary
    types = {name: _percentages(row) for name, row in summary.memory_types.items()}
    tasks = {name: _percentages(task.rates) for name, task in summary.tasks.items()}
    counted = {"tasks": tasks, "memory_types": types, "average": _percentages(summary.average)}
    return {**counted, "failures": dict(summary.failures), **evidence_values(run)}


def _percentages(row: Mapping[str, Rate]) -> dict[str, Any]:
    rates = {metric: None if (value := row[metric].value) is None else 100 * value for metric in PAPER_METRICS}
    return {"n": row["SR"].n, **rates}


@cache
def _rollouts(folder: Path) -> list[Record]:
    return list(read_run(folder).records)


def _runs(cells: Sequence[Cell], part: str = ROLLOUTS) -> list[list[Record]]:
    return [_rollouts(cell.evaluation(part)) for cell in cells]


def _evidence(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """Return "follows", "chance" and "scenes" of each training seed; [] where no task has a chance."""
    reports = [report(cell, EVIDENCE).get("evidence") for cell in cells if evaluated(cell, EVIDENCE)]
    return [found["average"] for found in reports if found and found["average"]]


# -- tables -----------------------------------------------------------------------------------------------------------


def _summary(rows: Rows, ceilings: Mapping[str, float]) -> str:
    header = ("", "training seeds", "SR", "95 %", "of seeds", *PROCESS_METRICS)
    more = ("follows evidence, last seed", "chance", "scenes")
    lines = [_summary_line(row, cells) for row, cells in rows.items()]
    if ceilings:
        empty = [EMPTY] * (len(header + more) - 3)
        lines.insert(0, [CEILING, EMPTY, _figure(_ceiling(ceilings)), *empty])
    return table_of((*header, *more), lines)


def _ceiling(ceilings: Mapping[str, float]) -> float | None:
    """Return the mean over memory types of their tasks' ceilings, as SR is averaged."""
    of_types = [
        [value for name, value in ceilings.items() if get_task(name).memory_type == kind] for kind in MEMORY_TYPES
    ]
    return _mean_of([_mean_of(values) for values in of_types])


def _summary_line(row: str, cells: Sequence[Cell]) -> list[str]:
    reports = [report(cell, ROLLOUTS) for cell in cells]
    columns = [EMPTY] * 3
    if evidence := _evidence(cells):
        follows = evidence[0]["follows"]
        rate = f"{follows['percent']:.1f} ({follows['low']:.1f}–{follows['high']:.1f})"
        columns = [rate, f"{evidence[0]['chance']:.1f}", str(evidence[0]["scenes"])]
    return [
        row,
        str(len(cells)),
        *_with_interval(average_success(_runs(cells))),
        ", ".join(f"{report['average']['SR']:.0f}" for report in reports),
        *(_average(reports, metric) for metric in PROCESS_METRICS),
        *columns,
    ]


def _by_memory_type(rows: Rows) -> str:
    header = ("", *(f"{kind} {metric}" for kind in MEMORY_TYPES for metric in PAPER_METRICS))
    lines = []
    for row, cells in rows.items():
        types = [report(cell, ROLLOUTS)["memory_types"] for cell in cells]
        rates = [
            _mean([(one.get(kind) or {}).get(metric) for one in types])
            for kind in MEMORY_TYPES
            for metric in PAPER_METRICS
        ]
        lines.append([row, *rates])
    return table_of(header, lines)


def by_task(rows: Rows) -> tuple[list[str], dict[str, list[float | None]]]:
    """Return tasks, and of each row its success in them: per cent, of all training seeds; None where it has none."""
    found = {row: [report(cell, ROLLOUTS)["tasks"] for cell in cells] for row, cells in rows.items()}
    names = list(dict.fromkeys(name for own in found.values() for one in own for name in one))
    return names, {
        row: [_mean_of([one[name]["SR"] for one in own if name in one]) for name in names] for row, own in found.items()
    }


def _by_task(rows: Rows, ceilings: Mapping[str, float]) -> str:
    names, solved = by_task(rows)
    lines = [
        [f"`{name}`", *map(_figure, (ceilings.get(name), *values))]
        for name, *values in zip(names, *solved.values(), strict=True)
    ]
    return table_of(("", CEILING, *rows), lines)


def _endings(rows: Rows) -> str:
    counts = {row: Counter[str]() for row in rows}
    for row, cells in rows.items():
        for one in (report(cell, ROLLOUTS) for cell in cells):
            counts[row].update(success=one["average"]["n"] - sum(one["failures"].values()), **one["failures"])
    classes = list(dict.fromkeys(name for count in counts.values() for name in count))
    lines = [[name.replace("_", " "), *(str(counts[row][name]) for row in rows)] for name in classes]
    return table_of(("", *rows), lines)


def _conditions(rows: Rows) -> str:
    last = {row: cells[-1] for row, cells in rows.items()}
    parts = dict.fromkeys(part for cell in last.values() for part in cell.grid.rows[cell.row].controls)
    there = {row: [part for part in parts if part != EVIDENCE and evaluated(cell, part)] for row, cell in last.items()}
    wanted = [part for part in parts if any(part in own for own in there.values())]
    lines = [
        [row, _average([report(last[row], ROLLOUTS)], "SR")]
        + [_condition(last[row], part, own) if part in own else EMPTY for part in wanted]
        for row, own in there.items()
        if own
    ]
    return table_of(("", "as it is", *wanted), lines) if lines else ""


def _condition(cell: Cell, part: str, parts: Sequence[str]) -> str:
    """Return SR in a control, and its change from the first other part with the same episodes, points and interval."""
    success = _average([report(cell, part)], "SR")
    runs = _runs([cell], part)
    for other in (ROLLOUTS, *parts[: parts.index(part)]):
        if episodes_of(without := _runs([cell], other)) == episodes_of(runs):
            change = contrast(runs, without, part, other)
            return f"{success} ({100 * change.value:+.1f}, {100 * change.low:+.1f} to {100 * change.high:+.1f})"
    return success


def _sealed(rows: Rows) -> str:
    lines = []
    for row, cells in rows.items():
        if tested := [cell for cell in cells if evaluated(cell, SEALED)]:
            success = average_success(_runs(tested, SEALED))
            reports = [report(cell, SEALED) for cell in tested]
            averages = [_average(reports, metric) for metric in PROCESS_METRICS]
            lines.append([row, str(len(tested)), *_with_interval(success), *averages])
    return table_of(("", "training seeds", "SR", "95 %", *PROCESS_METRICS), lines) if lines else ""


def _above_ceiling(rows: Rows, ceilings: Mapping[str, float]) -> str:
    ceiling = _ceiling(ceilings)
    if ceiling is None:
        return ""
    lines = []
    for row, cells in rows.items():
        success = average_success(_runs(cells))
        value, low, high = (
            f"{100 * (one or 0.0) - ceiling:+.1f}" for one in (success.value, success.low, success.high)
        )
        lines.append([row, str(len(cells)), value, f"{low} to {high}"])
    return table_of(("", "training seeds", "difference, points", "95 %"), lines)


def _differences(grid: Grid, rows: Rows, part: str) -> Iterator[tuple[str, str]]:
    """Yield a title and a table of each family of contrasts, by the training seeds that both rows have."""
    for family, pairs in grid.contrasts.items():
        found = {}
        for row, reference in pairs:
            base = {cell.seed: cell for cell in rows.get(reference, ()) if evaluated(cell, part)}
            if shared := [cell for cell in rows.get(row, ()) if cell.seed in base and evaluated(cell, part)]:
                others = [base[cell.seed] for cell in shared]
                found[f"{row} minus {reference}"] = contrast(_runs(shared, part), _runs(others, part), row, reference)
        if found:
            yield f"Contrasts, {family}, {part}", _contrasts_table(adjusted(found))


def _contrasts_table(found: Mapping[str, SeedContrast]) -> str:
    lines = [
        [
            name,
            str(each.episodes),
            f"{100 * each.value:+z.1f}",
            f"{100 * each.low:+.1f} to {100 * each.high:+.1f}",
            _probability(each.p),
            ", ".join(f"{100 * value:+z.0f}" for value in each.of_seeds),
            _probability(each.p_of_seeds),
            EMPTY if each.detectable is None else f"{100 * each.detectable:.1f}",
        ]
        for name, each in found.items()
    ]
    tests = ("p of episodes (Holm)", "of training seeds", "p of training seeds (Holm)")
    return table_of(("", "episodes", "difference, points", "95 %", *tests, "detectable"), lines)


def _probability(p: float | None) -> str:
    if p is None:
        return EMPTY
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def table_of(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))


def _costs(rows: Rows) -> str:
    lines = []
    for row, cells in rows.items():
        trained = [cost[TRAINING].wall_s / 60 for cell in cells if TRAINING in (cost := cell.costs())]
        runs = _runs(cells)
        lines.append(
            [row, _mean(trained), _mean([1000 * sum(one["wall_s"] for one in run) / _steps(run) for run in runs])]
        )
    return table_of(("", "training, min", "a simulated step, prompt included, ms"), lines)


def _steps(records: Sequence[Record]) -> int:
    return sum(int(record["steps"]) + int(record["prompt_steps"] or 0) for record in records)


def _with_interval(success: Estimate) -> tuple[str, str]:
    assert None not in (success.value, success.low, success.high)
    value, low, high = (100 * (one or 0.0) for one in (success.value, success.low, success.high))
    return f"**{value:.1f}**", f"{low:.1f}–{high:.1f}"


def _average(reports: Sequence[Mapping[str, Any]], metric: str) -> str:
    return _mean([one["average"][metric] for one in reports])


def _mean_of(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return mean(known) if known else None


def _mean(values: Sequence[float | None]) -> str:
    return _figure(_mean_of(values))


def _figure(value: float | None) -> str:
    return EMPTY if value is None else f"{value:.1f}"
