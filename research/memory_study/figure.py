"""The figure of the study: success of each row, and how often it follows the evidence, one panel per suite."""

from __future__ import annotations

from pathlib import Path
from statistics import mean
from typing import Any

from lerobot_memobench.io import draft_of
from research.memory_study.grid import Grid
from research.memory_study.tables import figures_of_rows

SOLVED, FOLLOWS, WITHOUT = "#0072b2", "#e69f00", "#d55e00"
"""Colours of success, of choices that follow the evidence, and of the ceiling without a memory."""
ROW_HEIGHT, PANEL_WIDTH = 0.32, 5.6
"""Inches."""


def draw(grid: Grid, out: Path, path: Path) -> Path | None:
    """Draw the evaluated rows to ``path``, each suite's by descending success; return it, or None without any."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    suites = {suite: found for suite in grid.suites if (found := figures_of_rows(grid, out, suite))}
    if not suites:
        return None
    longest = max(map(len, suites.values()))
    size = (PANEL_WIDTH * len(suites), 1.6 + ROW_HEIGHT * longest)
    figure, axes = plt.subplots(1, len(suites), figsize=size, squeeze=False, constrained_layout=True)
    for axis, (suite, found) in zip(axes[0], suites.items(), strict=True):
        _draw_suite(axis, suite, found)
    handles = {
        label: handle
        for axis in axes[0]
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)  # a suite may lack evidence
    }
    figure.legend(
        handles.values(), handles.keys(), loc="outside lower center", ncols=2 * len(suites), frameon=False, fontsize=9
    )
    with draft_of(path) as draft:
        figure.savefig(draft, dpi=130)
    plt.close(figure)
    return path


def _draw_suite(axis: Any, suite: str, found: dict[str, dict[str, Any]]) -> None:
    rows = sorted(found, key=lambda row: mean(found[row]["solved"]), reverse=True)
    places = range(len(rows))
    axis.barh(places, [mean(found[row]["solved"]) for row in rows], 0.7, color=SOLVED, alpha=0.75, label="solved")
    seeds = [(value, place) for place, row in enumerate(rows) for value in found[row]["solved"]]
    axis.plot(*zip(*seeds, strict=True), "o", color="black", markersize=3.5, label="solved, each training seed")
    follows = [(value, place) for place, row in enumerate(rows) for value in found[row]["follows"]]
    if follows:
        axis.plot(
            *zip(*follows, strict=True), "D", color=FOLLOWS, markersize=6, label="choices that follow the evidence"
        )
    for place, row in enumerate(rows):
        axis.text(1, place, f"{mean(found[row]['solved']):.0f}", va="center", fontsize=8, color="white")
    without = found[rows[0]]["without"]
    if without is not None:
        axis.axvline(without, color=WITHOUT, linewidth=2, label="exact ceiling without a memory")
    axis.set_yticks(places, rows)
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_title(suite, fontsize=11)
    axis.set_xlabel("%")
    axis.spines[["top", "right"]].set_visible(False)
