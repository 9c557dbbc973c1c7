"""Figures of the study: what each row solves and follows, what of each task, and how that grew with updates."""

from __future__ import annotations

import math
from itertools import cycle
from pathlib import Path
from statistics import mean
from textwrap import shorten
from typing import Any

from lerobot_memobench.evaluation.metrics import METRICS
from research.drawing import pyplot, save
from research.learning.results import COLOURS
from research.memory_study.grid import Grid
from research.memory_study.tables import by_task, curves, evaluated_rows, figures_of_rows, titles

CHANCE_COLOUR = "#d55e00"
MEASURES = {"solved": "solved, %", "follows": "follows the evidence, %"}


def draw_all(grid: Grid, out: Path, figures: Path) -> list[Path]:
    """Draw what has been evaluated in ``out`` into the folder ``figures``; return the files."""
    figures.mkdir(parents=True, exist_ok=True)
    found = [draw(grid, out, figures / "study.png")]
    for suite in grid.suites:
        found.append(draw_tasks(grid, out, suite, figures / f"study_tasks_{suite}.png"))
        found.append(draw_curves(grid, out, suite, figures / f"study_updates_{suite}.png"))
    return [path for path in found if path]


def draw(grid: Grid, out: Path, path: Path) -> Path | None:
    """Draw what has been evaluated to ``path``; return it, or None where nothing has.

    A bar is the mean of training seeds, a dot one of them; an orange line is the best without the past: what a
    search found to be solved, and the exact chance of following.
    """
    plt = pyplot()
    suites = {suite: found for suite in grid.suites if (found := figures_of_rows(grid, out, suite))}
    if not suites:
        return None
    rows = [row for row in titles(grid) if any(row in found for found in suites.values())]
    size = (2.0 + 2.6 * len(suites) * len(MEASURES), 1.2 + 0.3 * len(rows))
    figure, axes = plt.subplots(
        1, len(suites) * len(MEASURES), figsize=size, sharey=True, squeeze=False, constrained_layout=True
    )
    panels = [(suite, measure) for suite in suites for measure in MEASURES]
    for axis, (suite, measure) in zip(axes[0], panels, strict=True):
        for place, row in enumerate(rows):
            _draw_row(axis, place, suites[suite].get(row), measure)
        axis.set_xlim(0, 100)
        axis.set_title(suite, fontsize=10)
        axis.set_xlabel(MEASURES[measure])
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_yticks(range(len(rows)), rows)
    axes[0][0].invert_yaxis()
    return save(figure, path)


def draw_tasks(grid: Grid, out: Path, suite: str, path: Path) -> Path | None:
    """Draw the success of each row in each task of a suite to ``path``, beside the best found without a memory."""
    rows = evaluated_rows(grid, out, suite)
    if not rows:
        return None
    ceilings = grid.suites[suite].ceilings
    tasks, solved = by_task(rows)
    columns = {"best found without": [ceilings.get(task) for task in tasks]} if ceilings else {}
    columns |= solved
    figure, axis = pyplot().subplots(
        figsize=(4.4 + 0.46 * len(columns), 1.9 + 0.27 * len(tasks)), constrained_layout=True
    )
    lines = [[math.nan if value is None else value for value in line] for line in zip(*columns.values(), strict=True)]
    axis.imshow(lines, cmap="Blues", vmin=0, vmax=100, aspect="auto")
    for x, values in enumerate(columns.values()):
        for y, value in enumerate(values):
            if value is not None:
                axis.text(x, y, f"{value:.0f}", ha="center", va="center", fontsize=7, color="wk"[value < 60])
    axis.set_xticks(range(len(columns)), list(columns), rotation=45, ha="right", fontsize=8)
    axis.set_yticks(
        range(len(tasks)), [shorten(task.replace("_", " "), 52, placeholder="…") for task in tasks], fontsize=8
    )
    axis.tick_params(length=0)
    axis.set_title(f"{suite}: solved, %", fontsize=10)
    return save(figure, path)


def draw_curves(grid: Grid, out: Path, suite: str, path: Path) -> Path | None:
    """Draw success and satisfied checkpoints against updates to ``path``, of the rows with earlier checkpoints."""
    found = curves(evaluated_rows(grid, out, suite))
    if not found:
        return None
    figure, axes = pyplot().subplots(
        1, len(METRICS), figsize=(2.6 * len(METRICS), 2.9), sharey=True, constrained_layout=True
    )
    for axis, metric in zip(axes, METRICS, strict=True):
        for colour, (row, points) in zip(cycle(COLOURS), found.items(), strict=False):
            seeds = [(updates, value) for updates, told in points for one in told if (value := one[metric]) is not None]
            means = {n: mean(value for updates, value in seeds if updates == n) for n, _ in seeds}
            axis.plot(list(means), list(means.values()), "-", color=colour, label=row)
            axis.plot(*zip(*seeds, strict=True), "o", color=colour, markersize=3)
        axis.set(ylim=(0, 100), title=metric, xlabel="updates")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].set_ylabel(f"{suite}, %")
    axes[0].legend(fontsize=7, frameon=False, loc="upper left")
    return save(figure, path)


def _draw_row(axis: Any, place: int, told: dict[str, Any] | None, measure: str) -> None:
    if told is None or not told[measure]:
        axis.text(1, place, "not run", va="center", fontsize=7, color="grey")
        return
    of_seeds, without = told[measure], told["without"][measure]
    average = mean(of_seeds)
    axis.barh(place, average, 0.7, color=COLOURS[list(MEASURES).index(measure)], alpha=0.75)
    axis.plot(of_seeds, [place] * len(of_seeds), "o", color="black", markersize=3)
    axis.text(1, place, f"{average:.0f}", va="center", fontsize=8)
    if without is not None:
        axis.plot([without, without], [place - 0.42, place + 0.42], color=CHANCE_COLOUR, linewidth=2)
