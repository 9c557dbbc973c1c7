"""Rates by replan interval: one line per method, with Wilson's intervals where n is known (paper, main results)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.beside_paper import published_rate, with_extent
from lerobot_memobench.evaluation.documents.figures import style
from lerobot_memobench.evaluation.documents.figures.entries import Identity
from lerobot_memobench.evaluation.metrics.rates import METRICS, Rate
from lerobot_memobench.evaluation.records.runs import Run, sweeps
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.task import MEMORY_TYPES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AVERAGE = "average"

Curve = tuple[str, list[int], list[Rate], bool]
"""Method, replan intervals, rates there, whether they are the paper's."""


def curves(runs: Sequence[Run], paper: bool, memory_type: str, metric: str) -> list[Curve]:
    """Return the lines of one panel; ``memory_type`` may be "average"."""
    found: list[Curve] = []
    for method, group in sweeps(runs).items():
        rates = {}
        for run in group:
            row = run.summary.average if memory_type == AVERAGE else run.summary.memory_types.get(memory_type)
            if row is not None and row[metric].value is not None and run.replan_steps is not None:
                rates[run.replan_steps] = row[metric]
        if rates:
            found.append((method, list(rates), list(rates.values()), False))
    return found + (_published_curves(memory_type, metric) if paper else [])


def _published_curves(memory_type: str, metric: str) -> list[Curve]:
    models: dict[str, dict[int, Rate]] = {}
    for row in published_rows("main"):
        figures = row.average if memory_type == AVERAGE else row.memory_types[memory_type]
        value = figures[metric]
        if value is not None and row.replan_steps is not None:
            models.setdefault(row.label, {})[row.replan_steps] = published_rate(value)
    return [(name, list(rates), list(rates.values()), True) for name, rates in models.items()]


def draw(runs: Sequence[Run], paper: bool = False, by_type: bool = False) -> Figure:
    """Draw SR, MSR, MUR and MCR over replan intervals, on average or per memory type as well.

    Raises:
        MemobenchError: no method was evaluated at several intervals.
    """
    if not paper and not sweeps(runs):
        raise MemobenchError(
            "no policy was evaluated at several replan intervals; name evaluations with replan=5, replan=20 and so on "
            "(NAME=FOLDER with the same name where their policies are not known)"
        )
    groups = [AVERAGE, *(MEMORY_TYPES if by_type else ())]
    grid = {(g, metric): curves(runs, paper, g, metric) for g in groups for metric in METRICS}
    looks = style.looks((name, published) for cell in grid.values() for name, _, _, published in cell)
    with style.look():
        figure = style.new_figure(7.4, 1.75 * len(groups) + 0.75)
        places = figure.subplots(len(groups), len(METRICS), sharex=True, squeeze=False)
        for (group, metric), place in zip(grid, places.flat, strict=True):
            below = None if group == groups[-1] else grid[groups[groups.index(group) + 1], metric]
            _draw_panel(place, grid[group, metric], looks)
            if group == groups[0]:
                place.set_title(f"{metric} ({style.METRIC_NAMES[metric]})", fontsize=7.5)
            if metric == METRICS[0]:
                place.set_ylabel(f"{group}, %")
            if not below:
                place.set_xlabel("replan interval, steps")
                place.tick_params(labelbottom=True)
        _legend(figure, looks, sweeps(runs) if paper else {})
        return figure


def _draw_panel(place: Any, found: Sequence[Curve], looks: Mapping[Identity, style.Line]) -> None:
    if not found:
        place.set_visible(False)
        return
    for curve in found:
        _draw_curve(place, curve, looks[curve[0], curve[3]])
    _frame(place, found)


def _legend(figure: Figure, looks: Mapping[Identity, style.Line], ours: Mapping[str, Sequence[Run]]) -> None:
    """Name the lines; ``ours`` (method -> runs) say how much was run."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **look.drawn, ms=4, lw=_width(not theirs)) for (_, theirs), look in looks.items()]
    alone = all(published for _, published in looks)
    marks = [
        f"paper: {name}" if published and not alone else with_extent(name, ours.get(name, ())).replace(" (", "\n(")
        for name, published in looks
    ]
    longest = max(len(line) for mark in marks for line in mark.splitlines())
    style.legend_below(figure, handles, [style.words(mark) for mark in marks], 4 if longest < 27 else 3)


def _width(ours: bool) -> float:
    return 1.9 if ours else 1.1


def _draw_curve(place: Any, curve: Curve, look: style.Line) -> None:
    _, steps, rates, published = curve
    values = [math.nan if rate.value is None else 100 * rate.value for rate in rates]
    if not published:
        intervals = [rate.interval or (0.0, 1.0) for rate in rates]
        low, high = ([100 * bounds[k] for bounds in intervals] for k in (0, 1))
        place.fill_between(steps, low, high, color=look.colour, alpha=0.15, lw=0, zorder=1)
    order = 2 if published else 3
    place.plot(steps, values, **look.drawn, ms=4, lw=_width(not published), zorder=order, clip_on=False)


def _frame(place: Any, found: Sequence[Curve]) -> None:
    steps = sorted({step for _, its_steps, _, _ in found for step in its_steps})
    place.set_xticks(steps)
    place.set_ylim(bottom=0)
    # Room for markers at the top, and at least ten points of scale: noise is not to look like a trend.
    place.set_ylim(top=min(102.0, max(10.0, place.get_ylim()[1])))
    place.grid(axis="y", color=style.GRID, lw=0.5)
    place.locator_params(axis="y", nbins=5)
