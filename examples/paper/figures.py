"""The paper's figures, from the JSON of a report: radar, correlations of process metrics with success, prefix curves.

    memobench report mine=outputs/eval/k5 mine=outputs/eval/k20 --format json --out outputs/report
    python examples/paper/figures.py outputs/report/report.json --out outputs/figures

The paper's rows are drawn as well; prefix curves are of the evaluations alone.
"""

from __future__ import annotations

import argparse
import json
import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from published import published_rows

from lerobot_memobench.evaluation.metrics import PAPER_METRICS
from lerobot_memobench.evaluation.plots import (
    GRID,
    INK,
    legend_below,
    line_style,
    literal,
    new_figure,
    paper_style,
    save,
)

TYPE_LOOKS = {
    "temporal": ("#0072b2", "o"),
    "spatial": ("#d55e00", "s"),
    "object": ("#000000", "^"),
    "procedural": ("#cc79a7", "D"),
}
"""Memory type -> colour and marker of its points."""
HIGH_STORAGE, LOW_SUCCESS = 50.0, 20.0
"""Bounds of the shaded part, per cent: stored and not used. The paper shades such cases without giving bounds."""


class Row(NamedTuple):
    """One method at one replan interval; rates are per cent, None where a metric does not apply."""

    method: str
    published: bool
    memory_types: Mapping[str, Mapping[str, float | None]]
    average: Mapping[str, float | None]


def evaluations(report: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    """Return name -> figures of the evaluations of a report."""
    return report["evaluations"] if "evaluations" in report else {report["name"]: report}


def rows_of(report: Mapping[str, Any], *tables: str) -> list[Row]:
    """Return the rows of the evaluations, then those of some of the paper's tables."""
    ours = [Row(each["method"], False, each["memory_types"], each["average"]) for each in evaluations(report).values()]
    theirs = [Row(row.label, True, row.memory_types, row.average) for row in published_rows(*tables)]
    return [*ours, *theirs]


# --- radar ---


def best_over_replan(rows: Sequence[Row]) -> dict[tuple[str, bool], list[float | None]]:
    """Return whose row -> per metric the highest average over its replan intervals (the paper's rule)."""
    found: dict[tuple[str, bool], list[float | None]] = {}
    for row in rows:
        best = found.setdefault((row.method, row.published), [None] * len(PAPER_METRICS))
        for k, metric in enumerate(PAPER_METRICS):
            values = [value for value in (best[k], row.average[metric]) if value is not None]
            best[k] = max(values, default=None)
    return found


def draw_radar(panels: Mapping[str, Sequence[Row]]) -> Figure:
    """Draw one radar per panel; each axis is divided by its highest value. A gap does not apply."""
    with paper_style():
        figure = new_figure(3.8 * len(panels), 5.2)
        places = figure.subplots(1, len(panels), subplot_kw={"projection": "polar"}, squeeze=False)[0]
        for place, (title, rows) in zip(places, panels.items(), strict=True):
            best = best_over_replan(rows)
            tops = [max((row[k] or 0.0 for row in best.values()), default=0.0) for k in range(len(PAPER_METRICS))]
            angles = [2 * math.pi * k / len(PAPER_METRICS) for k in range(len(PAPER_METRICS))]
            place.set_theta_offset(math.pi / 2)
            place.set_theta_direction(-1)
            place.set_ylim(0, 1)
            place.set_yticks([0.25, 0.5, 0.75, 1.0], [])
            place.grid(color=GRID, lw=0.6)
            place.spines["polar"].set_visible(False)
            place.set_xticks(angles, [f"{metric}\n{top:.1f}" for metric, top in zip(PAPER_METRICS, tops, strict=True)])
            for number, ((method, published), values) in enumerate(best.items()):
                shares = [
                    math.nan if value is None else value / top if top else 0.0
                    for value, top in zip(values, tops, strict=True)
                ]
                label = literal(f"paper: {method}" if published else method)
                style = line_style(number, published)
                width = 1.3 if published else 2.0
                place.plot([*angles, 0], [*shares, shares[0]], **style, lw=width, label=label, clip_on=False)
            place.set_title(title, pad=24)
            place.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=7, handlelength=3.2)
        return figure


# --- process metrics against success ---

Point = tuple[float, float, str]
"""(process metric, SR, memory type), per cent."""


def points(rows: Sequence[Row], metric: str) -> list[Point]:
    """Return a point per row and memory type to which a metric applies."""
    return [
        (value, success, name)
        for row in rows
        for name, figures in row.memory_types.items()
        if (value := figures[metric]) is not None and (success := figures["SR"]) is not None
    ]


def pearson(found: Sequence[Point]) -> float | None:
    """Return Pearson's r of metric and SR; None for fewer than three points, or constant values."""
    x, y = (np.array([point[k] for point in found], dtype=float) for k in (0, 1))
    return float(np.corrcoef(x, y)[0, 1]) if len(found) > 2 and np.ptp(x) and np.ptp(y) else None


def draw_correlations(rows: Sequence[Row]) -> Figure:
    """Draw MSR, MUR and MCR against SR; evaluations are filled, the paper's rows open."""
    with paper_style():
        figure = new_figure(7.8, 3.1)
        for place, metric in zip(figure.subplots(1, 3, sharey=True), PAPER_METRICS[1:], strict=True):
            titles = []
            for published in (True, False):
                found = points([row for row in rows if row.published is published], metric)
                for x, y, name in found:
                    colour, marker = TYPE_LOOKS[name]
                    face = "none" if published else colour
                    place.scatter(x, y, 16, facecolors=face, edgecolors=colour, marker=marker, lw=0.8, clip_on=False)
                if found:
                    r = pearson(found)
                    correlation = "r not defined" if r is None else f"r = {r:.2f}"
                    titles.append(f"{'paper' if published else 'here'}: {correlation} ({len(found)} points)")
            place.set_title("\n".join(titles), fontsize=8)
            place.set_xlabel(f"{metric}, %")
            place.set_xlim(-4, 104)
            place.set_ylim(-4, 104)
            place.set_aspect("equal")
            place.plot([0, 100], [0, 100], color=GRID, lw=0.7, zorder=0)
            if metric == "MSR":
                place.fill_between([HIGH_STORAGE, 104], -4, LOW_SUCCESS, color="#ebebeb", lw=0, zorder=-1)
        figure.axes[0].set_ylabel("SR, %")
        handles = {
            name: Line2D([], [], ls="", color=colour, marker=marker, ms=5)
            for name, (colour, marker) in TYPE_LOOKS.items()
        }
        legend_below(figure, handles, 4)
        return figure


# --- prefix completion ---


def draw_prefix(report: Mapping[str, Any]) -> Figure:
    """Draw prefix completion per task, and dotted, where it differs, prefix completion in order."""
    runs = evaluations(report)
    tasks = list(dict.fromkeys(name for run in runs.values() for name in run["prefix"]))
    columns = min(4, len(tasks))
    with paper_style():
        figure = new_figure(max(1.85 * columns, 3.6), 1.8 * math.ceil(len(tasks) / columns) + 0.7)
        places = figure.subplots(math.ceil(len(tasks) / columns), columns, sharey=True, squeeze=False)
        handles: dict[str, Any] = {}
        for place in places.flat[len(tasks) :]:
            place.set_visible(False)
        for place, task in zip(places.flat, tasks, strict=False):
            for number, (name, run) in enumerate(runs.items()):
                if task not in run["prefix"]:
                    continue
                plain, ordered, style = run["prefix"][task], run["ordered_prefix"][task], line_style(number, False)
                steps = range(1, len(plain) + 1)
                (handles[name],) = place.plot(steps, plain, **style, lw=1.3, clip_on=False)
                if ordered != plain:
                    dotted = {**style, "ls": ":", "mfc": "white", "ms": 3}
                    place.plot(steps, ordered, **dotted, lw=0.9, clip_on=False)
                    handles["in order, where it differs"] = Line2D([], [], color=INK, ls=":", marker="o", mfc="white")
                place.set_xticks(steps, [f"c{k}" for k in steps])
            place.set_title(textwrap.fill(task.replace("_", " "), 30), fontsize=7)
            place.set_ylim(0, 102)
            place.grid(axis="y", color=GRID, lw=0.5)
        for place in places[:, 0]:
            place.set_ylabel("prefix completed, %")
        legend_below(figure, handles, 3)
        return figure


def main() -> None:
    """Draw the figures of a report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path, help="report.json that `memobench report --format json --out` wrote")
    parser.add_argument("--out", type=Path, default=Path("outputs/figures"), help="folder of the PDF and PNG files")
    chosen = parser.parse_args()
    report = json.loads(chosen.report.read_text())
    radars = {"Main results": rows_of(report, "main"), "Memory alignment": rows_of(report, "alignment")}
    figures = {
        "radar": draw_radar(radars),
        "correlations": draw_correlations(rows_of(report, "main")),
        "prefix": draw_prefix(report),
    }
    for name, figure in figures.items():
        for path in save(figure, chosen.out, name):
            print(path)


if __name__ == "__main__":
    main()
