"""Figures of rates: radar, process metrics against success, curves over replan intervals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.figures.style import (
    FAINT,
    GRID,
    INK,
    METRIC_NAMES,
    Axis,
    Entry,
    Identity,
    Line,
    best_over_replan,
    labels_of,
    legend_below,
    literal,
    looks_of,
    new_figure,
    paper_style,
    remarks_on,
    with_remarks,
)
from lerobot_memobench.evaluation.metrics import METRICS, PROCESS_METRICS, Rate
from lerobot_memobench.evaluation.records import Run, sweeps
from lerobot_memobench.evaluation.report_tables import published_rate
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.task import MEMORY_TYPES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


FEWEST_AXES = 3
LONGEST, ROW = 21, 0.2
"""Characters of a legend's line of which two stand beside one another; inches that a line takes."""


def normalised(
    entries: Sequence[Entry], axes: Sequence[Axis]
) -> tuple[list[Axis], list[float], dict[Identity, list[float | None]]]:
    """Return the axes that apply to any method, their highest values in per cent, and whose row -> shares of these.

    An axis that does not apply to a method, such as one whose tasks it was not evaluated on, has no share of it: None.
    """
    best = best_over_replan(entries, axes)
    columns = [[value for row in best.values() if (value := row[k]) is not None] for k in range(len(axes))]
    kept = [k for k, values in enumerate(columns) if values]
    tops = [max(columns[k]) for k in kept]
    shares = {whose: [_share(row[k], top) for k, top in zip(kept, tops, strict=True)] for whose, row in best.items()}
    return [axes[k] for k in kept], tops, shares


def _share(value: float | None, top: float) -> float | None:
    return None if value is None else value / top if top else 0.0


def draw_radar(panels: Sequence[tuple[str, Sequence[Entry]]], axes: Sequence[Axis]) -> Figure:
    """Draw one radar per panel (title, rows).

    Raises:
        MemobenchError: fewer than three axes apply.
    """
    legends = [labels_of(entries).values() for _, entries in panels]
    columns = 2 if max(len(line) for told in legends for label in told for line in label.splitlines()) <= LONGEST else 1
    rows = max(sum(1 + label.count("\n") for label in told) + 1 for told in legends) / columns
    with paper_style():
        height = (3.1 if columns == 2 else 3.8) + (0 if len(axes) <= 4 else 0.6) + ROW * rows
        figure = new_figure(3.6 * len(panels) if len(axes) <= 4 else 4.5 * len(panels), height)
        places = figure.subplots(1, len(panels), subplot_kw={"projection": "polar"}, squeeze=False)[0]
        looks = looks_of(entry.identity for _, entries in panels for entry in entries)
        for place, (title, entries) in zip(places, panels, strict=True):
            _draw_radar_panel(place, title, entries, axes, looks, columns)
        return figure


def _draw_radar_panel(
    place: Any,
    title: str,
    entries: Sequence[Entry],
    axes: Sequence[Axis],
    looks: Mapping[Identity, Line],
    columns: int,
) -> None:
    kept, tops, shares = normalised(entries, axes)
    if len(kept) < FEWEST_AXES:
        raise MemobenchError(
            f"a radar needs {FEWEST_AXES} axes and only {len(kept)} apply to these evaluations; evaluate more memory "
            "types, or use --axes types"
        )
    angles = [2 * math.pi * k / len(kept) for k in range(len(kept))]
    _draw_web(place, angles)
    labels = labels_of(entries)
    for (method, published), values in shares.items():
        width, label = 1.3 if published else 2.0, literal(labels[method, published])
        drawn = looks[method, published].drawn
        gaps = [math.nan if value is None else value for value in values]
        place.plot(_closed(angles), _closed(gaps), **drawn, ms=4, lw=width, label=label, zorder=3, clip_on=False)
    if any(None in values for values in shares.values()):
        place.plot([], [], ls="", label="a gap: not applicable, or not evaluated")
    for angle, axis, top in zip(angles, kept, tops, strict=True):
        _name_axis(place, angle, axis, top)
    place.set_title(title, pad=30 if len(kept) <= 4 else 34)
    place.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, -0.16 if len(kept) <= 4 else -0.2),
        ncols=columns,
        handlelength=3.2,
        columnspacing=1.2,
    )


def _closed(values: Sequence[float]) -> list[float]:
    return [*values, values[0]]


def _draw_web(place: Any, angles: Sequence[float]) -> None:
    """Draw rings and spokes, the first axis upwards, the others clockwise."""
    place.set_theta_offset(math.pi / 2)
    place.set_theta_direction(-1)
    place.set_ylim(0, 1.0)
    place.set_xticks([])
    place.set_yticks([])
    place.spines["polar"].set_visible(False)
    for ring in (0.25, 0.5, 0.75, 1.0):
        colour = GRID if ring < 1 else FAINT
        place.plot(_closed(angles), [ring] * (len(angles) + 1), color=colour, lw=0.6, zorder=1)
    for angle in angles:
        place.plot([angle, angle], [0, 1], color=GRID, lw=0.6, zorder=1)


def _name_axis(place: Any, angle: float, axis: Axis, top: float) -> None:
    """Write the name of an axis and its highest value outside the web."""
    memory_type, metric = axis
    name = metric if memory_type is None else f"{memory_type}\n{metric}"
    across, up = math.sin(angle), math.cos(angle)
    place.text(
        angle,
        1.08,
        f"{name}\n{top:.1f}",
        ha="center" if abs(across) < 0.3 else ("left" if across > 0 else "right"),
        va="center" if abs(up) < 0.3 else ("bottom" if up > 0 else "top"),
        fontsize=8 if memory_type is None else 7,
        linespacing=1.1,
    )


# --- process metrics against success: a point per method, replan interval and memory type (paper, main results) ---

Point = tuple[float, float, str]
"""(process metric, SR, memory type), per cent."""

HIGH_STORAGE, LOW_SUCCESS = 50.0, 20.0
"""What is shaded: much was stored, little was done with it. The paper shades such cases without giving bounds."""

SHADE = "#ebebeb"

LOOKS = dict[str, tuple[str, str]](
    zip(MEMORY_TYPES, (("#0072b2", "o"), ("#d55e00", "s"), ("#000000", "^"), ("#cc79a7", "D")), strict=True)
)


def points(entries: Sequence[Entry], metric: str, by_task: bool = False) -> list[Point]:
    """Return the points of a metric: every memory type of every row, or every task, to which it applies."""
    found: list[Point] = []
    for entry in entries:
        rows = entry.tasks if by_task else entry.memory_types
        for name, figures in rows.items():
            value, success = figures[metric], figures["SR"]
            if value is not None and success is not None:
                found.append((value, success, entry.memory_type_of[name] if by_task else name))
    return found


def pearson(found: Sequence[Point]) -> float | None:
    """Return Pearson's r of metric and SR; None where it is not defined: under three points, or constant values."""
    if len(found) < 3:
        return None
    x, y = np.array([(value, success) for value, success, _ in found]).T
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    return float(np.corrcoef(x, y)[0, 1])


def draw_correlations(entries: Sequence[Entry], by_task: bool = False) -> Figure:
    """Draw MSR, MUR and MCR against SR. Ours are filled, the paper's open.

    Raises:
        MemobenchError: there is nothing to draw.
    """
    metrics = [metric for metric in PROCESS_METRICS if points(entries, metric, by_task)]
    if not metrics:
        raise MemobenchError("no process metric applies to these evaluations; there is nothing to correlate")
    with paper_style():
        figure = new_figure(2.45 * len(metrics) + 0.4, 3.1)
        places = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
        for place, metric in zip(places, metrics, strict=True):
            _draw_correlations_panel(place, entries, metric, by_task)
        places[0].set_ylabel("SR, % (success)")
        there = {kind for metric in metrics for _, _, kind in points(entries, metric, by_task)}
        _correlations_legend(figure, entries, [name for name in MEMORY_TYPES if name in there], shaded="MSR" in metrics)
        return figure


def _both(entries: Sequence[Entry]) -> bool:
    """Whether some entries are the paper's and some are not."""
    return {entry.published for entry in entries} == {True, False}


def _draw_correlations_panel(place: Any, entries: Sequence[Entry], metric: str, by_task: bool) -> None:
    from matplotlib.patches import Rectangle

    texts = []
    for published in (True, False):
        found = points([entry for entry in entries if entry.published is published], metric, by_task)
        if found:
            _scatter(place, found, published)
            r = pearson(found)
            value = "r not defined" if r is None else f"r = {r:.2f}".replace("-", "−")
            whose = ("paper: " if published else "here: ") if _both(entries) else ""
            texts.append(f"{whose}{value} ({len(found)} points)")
    place.set_title("\n".join(texts), fontsize=8, fontweight="normal")
    place.set_xlabel(f"{metric}, % ({METRIC_NAMES[metric]})")
    place.set_xlim(-4, 104)
    place.set_ylim(-4, 104)
    place.set_xticks(range(0, 101, 25))
    place.set_yticks(range(0, 101, 25))
    place.set_aspect("equal")
    place.plot([0, 100], [0, 100], color=GRID, lw=0.7, zorder=0)
    if metric == "MSR":
        width, height = 104 - HIGH_STORAGE, LOW_SUCCESS + 4
        place.add_patch(Rectangle((HIGH_STORAGE, -4), width, height, facecolor=SHADE, edgecolor="none", zorder=-1))


def _correlations_legend(figure: Figure, entries: Sequence[Entry], memory_types: Sequence[str], shaded: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    fill = "none" if all(entry.published for entry in entries) else None
    handles: dict[str, Any] = {}
    for name in memory_types:
        colour, marker = LOOKS[name]
        handles[name] = Line2D([], [], ls="", color=colour, marker=marker, ms=5, mfc=fill)
    if _both(entries):
        handles["paper"] = Line2D([], [], ls="", marker="o", ms=5, mec=INK, mfc="none")
        handles["\n".join(["here", *_remarks(entries)])] = Line2D([], [], ls="", marker="o", ms=5, mec=INK, mfc=INK)
    if shaded:
        handles["high MSR, low SR"] = Patch(facecolor=SHADE)
    wide = sum(max(map(len, name.splitlines())) + 8 for name in handles) > 40 * figure.get_size_inches()[0] / 2.45
    legend_below(figure, list(handles.values()), list(handles), 4 if wide else len(handles))


def _remarks(entries: Sequence[Entry]) -> list[str]:
    """Return the remarks on ours."""
    told = dict.fromkeys(f"{entry.method}: {'; '.join(entry.remarks)}" for entry in entries if entry.remarks)
    alone = len({entry.method for entry in entries if not entry.published}) == 1
    return [literal(one.partition(": ")[2] if alone else one) for one in told]


def _scatter(place: Any, found: Sequence[Point], published: bool) -> None:
    for name in MEMORY_TYPES:
        x = [value for value, _, its_type in found if its_type == name]
        y = [success for _, success, its_type in found if its_type == name]
        colour, marker = LOOKS[name]
        place.scatter(
            x,
            y,
            s=16 if published else 24,
            marker=marker,
            facecolors="none" if published else colour,
            edgecolors=colour,
            linewidths=0.8,
            alpha=0.9,
            zorder=3,
            clip_on=False,
        )


# --- rates by replan interval: a line per method, with Wilson's intervals where n is known (paper, main results) ---

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


def draw_replan(runs: Sequence[Run], paper: bool = False, by_type: bool = False) -> Figure:
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
    looks = looks_of((name, published) for cell in grid.values() for name, _, _, published in cell)
    with paper_style():
        figure = new_figure(7.4, 1.75 * len(groups) + 0.75)
        places = figure.subplots(len(groups), len(METRICS), sharex=True, squeeze=False)
        for (group, metric), place in zip(grid, places.flat, strict=True):
            below = None if group == groups[-1] else grid[groups[groups.index(group) + 1], metric]
            _draw_replan_panel(place, grid[group, metric], looks)
            if group == groups[0]:
                place.set_title(f"{metric} ({METRIC_NAMES[metric]})", fontsize=7.5)
            if metric == METRICS[0]:
                place.set_ylabel(f"{group}, %")
            if not below:
                place.set_xlabel("replan interval, steps")
                place.tick_params(labelbottom=True)
        _replan_legend(figure, looks, sweeps(runs) if paper or len(set(map(remarks_on, runs))) > 1 else {})
        return figure


def _draw_replan_panel(place: Any, found: Sequence[Curve], looks: Mapping[Identity, Line]) -> None:
    if not found:
        place.set_visible(False)
        return
    for name, steps, rates, published in found:
        look = looks[name, published]
        values = [math.nan if rate.value is None else 100 * rate.value for rate in rates]
        if not published:
            intervals = [rate.interval or (0.0, 1.0) for rate in rates]
            low, high = ([100 * bounds[k] for bounds in intervals] for k in (0, 1))
            place.fill_between(steps, low, high, color=look.colour, alpha=0.15, lw=0, zorder=1)
        order = 2 if published else 3
        place.plot(steps, values, **look.drawn, ms=4, lw=_width(not published), zorder=order, clip_on=False)
    place.set_xticks(sorted({step for _, steps, _, _ in found for step in steps}))
    place.set_ylim(bottom=0)
    # Room for markers at the top, and at least ten points of scale: noise is not to look like a trend.
    place.set_ylim(top=min(102.0, max(10.0, place.get_ylim()[1])))
    place.grid(axis="y", color=GRID, lw=0.5)
    place.locator_params(axis="y", nbins=5)


def _replan_legend(figure: Figure, looks: Mapping[Identity, Line], ours: Mapping[str, Sequence[Run]]) -> None:
    """Name the lines; ``ours`` (method -> runs) say how they were run."""
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **look.drawn, ms=4, lw=_width(not theirs)) for (_, theirs), look in looks.items()]
    alone = all(published for _, published in looks)
    marks = [
        f"paper: {name}" if published and not alone else with_remarks(name, map(remarks_on, ours.get(name, ())))
        for name, published in looks
    ]
    longest = max(len(line) for mark in marks for line in mark.splitlines())
    legend_below(figure, handles, [literal(mark) for mark in marks], 4 if longest < 27 else 3)


def _width(ours: bool) -> float:
    return 1.9 if ours else 1.1
