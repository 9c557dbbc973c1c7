"""The figure of the study: success of each row, and how often it follows the evidence."""

from __future__ import annotations

from pathlib import Path
from statistics import mean
from typing import Any

from research.drawing import pyplot, save
from research.memory_study.grid import Grid
from research.memory_study.tables import figures_of_rows, titles

CHANCE_COLOUR = "#d55e00"
MEASURES = {"solved": ("solved, %", "#0072b2"), "follows": ("follows the evidence, %", "#e69f00")}
"""Figure of a row -> label and colour."""


def draw(grid: Grid, out: Path, path: Path) -> Path | None:
    """Draw the evaluated rows to ``path``; return it, or None without any.

    A bar is the mean of training seeds, a dot one of them. An orange line is the best without the past: the success
    that a search found, and the chance of following.
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
        axis.set_xlabel(MEASURES[measure][0])
        axis.spines[["top", "right"]].set_visible(False)
    axes[0][0].set_yticks(range(len(rows)), rows)
    axes[0][0].invert_yaxis()
    return save(figure, path)


def _draw_row(axis: Any, place: int, row: dict[str, Any] | None, measure: str) -> None:
    if row is None or not row[measure]:
        axis.text(1, place, "not run", va="center", fontsize=7, color="grey")
        return
    of_seeds, without = row[measure], row["without"][measure]
    average = mean(of_seeds)
    axis.barh(place, average, 0.7, color=MEASURES[measure][1], alpha=0.75)
    axis.plot(of_seeds, [place] * len(of_seeds), "o", color="black", markersize=3)
    axis.text(1, place, f"{average:.0f}", va="center", fontsize=8)
    if without is not None:
        axis.plot([without, without], [place - 0.42, place + 0.42], color=CHANCE_COLOUR, linewidth=2)
