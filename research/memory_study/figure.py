"""The study's figure: what each row solves, and how often it follows the evidence, beside chance."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lerobot_memobench.io import draft_of
from research.learning.results import COLOURS
from research.memory_study.grid import Grid
from research.memory_study.tables import figures_of_rows

CHANCE_COLOUR = "#d55e00"
MEASURES = {"solved": "solved, %", "follows": "follows the evidence, %"}


def draw(grid: Grid, out: Path, path: Path) -> Path | None:
    """Draw what has been evaluated to ``path``; return it, or None where nothing has.

    A bar is the mean of training seeds, a dot one of them; an orange line is the best rate without the past.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    suites = {suite: found for suite in grid.suites if (found := figures_of_rows(grid, out, suite))}
    if not suites:
        return None
    rows = [row for row in grid.rows if any(row in found for found in suites.values())]
    size = (2.0 + 2.6 * len(suites) * len(MEASURES), 1.2 + 0.3 * len(rows))
    figure, axes = plt.subplots(
        1, len(suites) * len(MEASURES), figsize=size, sharey=True, squeeze=False, constrained_layout=True
    )
    panels = [(suite, measure) for suite in suites for measure in MEASURES]
    for axis, (suite, measure) in zip(axes[0], panels, strict=True):
        for place, row in enumerate(rows):
            if row in suites[suite]:
                _draw_row(axis, place, suites[suite][row][measure], suites[suite][row]["chance"], measure)
        axis.set_xlim(0, 100)
        axis.set_title(suite, fontsize=10)
        axis.set_xlabel(MEASURES[measure])
        axis.spines[["top", "right"]].set_visible(False)
    names = [row + (" (privileged)" if grid.rows[row].privileged else "") for row in rows]
    axes[0][0].set_yticks(range(len(rows)), names)
    axes[0][0].invert_yaxis()
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130)
    plt.close(figure)
    return path


def _draw_row(axis: Any, place: int, of_seeds: list[float], chance: float | None, measure: str) -> None:
    if not of_seeds:
        return
    mean = sum(of_seeds) / len(of_seeds)
    axis.barh(place, mean, 0.7, color=COLOURS[list(MEASURES).index(measure)], alpha=0.75)
    axis.plot(of_seeds, [place] * len(of_seeds), "o", color="black", markersize=3)
    axis.text(1, place, f"{mean:.0f}", va="center", fontsize=8)
    if measure == "follows" and chance is not None:
        axis.plot([chance, chance], [place - 0.42, place + 0.42], color=CHANCE_COLOUR, linewidth=2)
