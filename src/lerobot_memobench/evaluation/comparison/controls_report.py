"""The controls as reports: tables that `formats` writes for the terminal, as Markdown and LaTeX, and JSON values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.evaluation.comparison.controls import AVERAGE, Contrast, Estimate, PrefixCurve, as_percent
from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE, Cell, Name, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate, Record, Row, summarise

PAPER = "paper"
PAPER_TASK = "paper, stove task of three checkpoints"
PAPER_GRANULARITY = {"coarse": (4, 50), "intermediate": (3, 50), "fine": (3, 50)}
"""Successful rollouts of that task by subgoal level (paper, annotation granularity; said in its text only)."""

Contrasts = Mapping[str, Mapping[str, Contrast]]
Labels = Mapping[str, Sequence[Record]]


def number(value: float | None, sign: bool = False) -> str:
    """Return a fraction as per cent with one decimal."""
    if value is None:
        return NOT_APPLICABLE
    return f"{100.0 * value:+.1f}" if sign else f"{100.0 * value:.1f}"


def estimate(found: Estimate, sign: bool = False) -> str:
    """Return an estimate with its interval."""
    if found.low is None or found.high is None:
        return number(found.value, sign)
    return f"{number(found.value, sign)} [{number(found.low, sign)}, {number(found.high, sign)}]"


# --- oracle memory ---


def oracle_report(found: Mapping[int | None, Contrasts], paper: tuple[int, Contrasts] | None = None) -> Report:
    """Return the decomposition, one table per replan interval.

    Args:
        paper: the published contrasts and their replan interval; in rows of their own under ours of that interval, or
            in a table of their own.
    """
    tables, data = [], {}
    for replan, contrasts in found.items():
        beside = paper[1] if paper is not None and replan == paper[0] else None
        tables.append(_oracle_table(replan, contrasts, beside))
        data[str(replan)] = as_percent(contrasts)
    if paper is not None:
        data[PAPER] = as_percent(paper[1])
        if paper[0] not in found:
            tables.append(_oracle_table(paper[0], paper[1], None, f", {PAPER}"))
    return Report(
        "Oracle memory decomposition",
        (
            Section(
                "",
                tuple(tables),
                sentences=(
                    "Cells are standard/oracle in per cent. Gap closed is (oracle − standard)/(100 − standard), with "
                    "the 95 % interval of a bootstrap over paired episodes; – where an operation does not occur, or "
                    "the gap is under one point.",
                ),
            ),
        ),
        data,
    )


def _oracle_table(replan: int | None, found: Contrasts, beside: Contrasts | None, suffix: str = "") -> Table:
    rows: list[tuple[Cell, ...]] = []
    strong = set()
    for name, metrics in found.items():
        if name == AVERAGE:
            strong.add(len(rows))
        rows.append((name, *_oracle_cells(metrics)))
        if beside is not None and name in beside:
            rows.append((f"{name}, {PAPER}", *_oracle_cells(beside[name])))
    title = f"replan interval {'unknown' if replan is None else replan}{suffix}"
    header = ("memory type", *METRICS, *(f"{metric} gap closed" for metric in METRICS))
    return Table(f"oracle_{replan}", title, header, tuple(rows), strong=frozenset(strong))


def _oracle_cells(metrics: Mapping[str, Contrast]) -> list[Cell]:
    pairs = [
        NOT_APPLICABLE if metrics[m].standard is None else f"{number(metrics[m].standard)}/{number(metrics[m].other)}"
        for m in METRICS
    ]
    return [*pairs, *(estimate(metrics[m].closed) for m in METRICS)]


# --- shuffled memory ---


def shuffled_report(
    found: Mapping[int | None, Sequence[PrefixCurve]], published: Mapping[str, Sequence[float]] | None = None
) -> Report:
    """Return prefix completion with normal and with shuffled memory per task, and their difference.

    Args:
        published: the paper's, per cent, ``normal`` and ``shuffled``.
    """
    tables = [_shuffled_table(replan, curves) for replan, curves in found.items()]
    if published is not None:
        tables.append(_published_shuffled(published))
    sentence = (
        "Rollouts in which a checkpoint and all before it were satisfied, per cent, with Wilson's 95 % interval. The "
        "difference is shuffled − normal, with its bootstrap interval over paired episodes."
    )
    data: dict[str, Any] = {str(replan): as_percent(list(curves)) for replan, curves in found.items()}
    if published is not None:
        data[PAPER] = dict(published)
    return Report("Shuffled memory", (Section("", tuple(tables), sentences=(sentence,)),), data)


def _shuffled_table(replan: int | None, curves: Sequence[PrefixCurve]) -> Table:
    width = max(len(curve.normal) for curve in curves) - 1
    rows: list[tuple[Cell, ...]] = []
    for curve in curves:
        for memory, rates in (("normal", curve.normal), ("shuffled", curve.other)):
            rows.append(_curve_row(Name(curve.task), memory, [Rate(rate, curve.n) for rate in rates], width))
        change = [estimate(difference, sign=True) for difference in curve.differences]
        rows.append(_curve_row(Name(curve.task), "difference", change, width))
    title = f"replan interval {'unknown' if replan is None else replan}"
    return Table(f"shuffled_{replan}", title, _curve_header("memory", width), tuple(rows))


def _published_shuffled(published: Mapping[str, Sequence[float]]) -> Table:
    """The last of the paper's three figures is that of the last checkpoint, which it calls final success too."""
    normal, shuffled = ([rate / 100.0 for rate in published[key]] for key in ("normal", "shuffled"))
    change = [b - a for a, b in zip(normal, shuffled, strict=True)]
    rows = [
        _curve_row(PAPER_TASK, memory, [*cells, cells[-1]], len(cells))
        for memory, cells in (
            ("normal", [number(rate) for rate in normal]),
            ("shuffled", [number(rate) for rate in shuffled]),
            ("difference", [number(rate, sign=True) for rate in change]),
        )
    ]
    return Table("shuffled_paper", PAPER, _curve_header("memory", len(normal)), tuple(rows))


def _curve_header(second: str, width: int) -> tuple[str, ...]:
    return ("task", second, *(f"c{k + 1}" for k in range(width)), "success")


def _curve_row(task: str, second: str, cells: Sequence[Cell], width: int) -> tuple[Cell, ...]:
    """A row of a task with fewer checkpoints than the widest has empty cells; success comes last."""
    *checkpoints, success = cells
    return (task, second, *checkpoints, *([None] * (width - len(checkpoints))), success)


# --- annotation granularity ---


def granularity_report(levels: Labels, own_labels: Labels, paper: bool = False) -> Report:
    """Return metrics by language level and prefix completion by level.

    Args:
        levels: level → rollouts of the policy that was taught at it, with the evaluated (intermediate) labels.
        own_labels: the same rollouts with the level's own operation labels.
        paper: add the published successes.
    """
    summaries = {level: summarise(records) for level, records in levels.items()}
    own = {level: summarise(records) for level, records in own_labels.items()}
    process = [metric for metric in METRICS if metric != "SR"]
    rates = Table(
        "granularity",
        "metrics by level",
        ("level", *METRICS, *(f"{metric}, own labels" for metric in process)),
        tuple(
            (level, *_cells(summary.average, METRICS), *_cells(own[level].average, process))
            for level, summary in summaries.items()
        ),
    )
    width = max(len(record["checkpoints"]) for records in levels.values() for record in records)
    names = list(dict.fromkeys(task for summary in summaries.values() for task in summary.tasks))
    rows = [
        _curve_row(Name(task), level, [*summary.prefix[task], summary.tasks[task]["SR"]], width)
        for task in names
        for level, summary in summaries.items()
        if task in summary.tasks
    ]
    if paper:
        for level, (good, n) in PAPER_GRANULARITY.items():
            rows.append(_curve_row(PAPER_TASK, level, [*([None] * width), Rate(good / n, n)], width))
    curves = Table("granularity_prefix", "prefix completion by level", _curve_header("level", width), tuple(rows))
    sentence = (
        "Per cent with Wilson's 95 % interval over rollouts. MSR, MUR and MCR are averages over memory types, under "
        "the evaluated (intermediate) labels and under those of the level itself."
    )
    data = {
        level: {
            "n": summaries[level].pooled["SR"].n,
            "average": _plain(summaries[level].average),
            "own_labels": _plain(own[level].average),
            "tasks": {
                task: {
                    "SR": as_percent(row["SR"].value),
                    "prefix": [as_percent(rate.value) for rate in summaries[level].prefix[task]],
                }
                for task, row in summaries[level].tasks.items()
            },
        }
        for level in levels
    }
    return Report("Annotation granularity", (Section("", (rates, curves), sentences=(sentence,)),), data)


def _cells(row: Row, metrics: Sequence[str] | Mapping[str, Any]) -> list[Cell]:
    return [row[metric] for metric in metrics]


def _plain(row: Row) -> dict[str, float | None]:
    return {metric: as_percent(rate.value) for metric, rate in row.items()}
