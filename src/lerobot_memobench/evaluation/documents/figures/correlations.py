"""Process metrics against success: one point per method, replan interval and memory type (paper, main results)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.figures import style
from lerobot_memobench.evaluation.documents.figures.entries import Entry
from lerobot_memobench.evaluation.metrics.rates import PROCESS_METRICS
from lerobot_memobench.tasks.task import MEMORY_TYPES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def draw(entries: Sequence[Entry], by_task: bool = False) -> Figure:
    """Draw MSR, MUR and MCR against SR. Ours are filled, the paper's open.

    Raises:
        MemobenchError: there is nothing to draw.
    """
    metrics = [metric for metric in PROCESS_METRICS if points(entries, metric, by_task)]
    if not metrics:
        raise MemobenchError("no process metric applies to these evaluations; there is nothing to correlate")
    with style.look():
        figure = style.new_figure(2.45 * len(metrics) + 0.4, 3.1)
        places = figure.subplots(1, len(metrics), sharey=True, squeeze=False)[0]
        for place, metric in zip(places, metrics, strict=True):
            _draw_panel(place, entries, metric, by_task)
        places[0].set_ylabel("SR, % (success)")
        there = {kind for metric in metrics for _, _, kind in points(entries, metric, by_task)}
        _legend(figure, entries, [name for name in MEMORY_TYPES if name in there], shaded="MSR" in metrics)
        return figure


def _both(entries: Sequence[Entry]) -> bool:
    """Whether some entries are the paper's and some are not."""
    return {entry.published for entry in entries} == {True, False}


def _draw_panel(place: Any, entries: Sequence[Entry], metric: str, by_task: bool) -> None:
    texts = []
    for published in (True, False):
        found = points([entry for entry in entries if entry.published is published], metric, by_task)
        if found:
            _scatter(place, found, published)
            whose = "paper: " if published else "here: "
            texts.append(_text(found, whose if _both(entries) else ""))
    place.set_title("\n".join(texts), fontsize=8, fontweight="normal")
    place.set_xlabel(f"{metric}, % ({style.METRIC_NAMES[metric]})")
    place.set_xlim(-4, 104)
    place.set_ylim(-4, 104)
    place.set_xticks(range(0, 101, 25))
    place.set_yticks(range(0, 101, 25))
    place.set_aspect("equal")
    place.plot([0, 100], [0, 100], color=style.GRID, lw=0.7, zorder=0)
    if metric == "MSR":
        _shade(place)


def _legend(figure: Figure, entries: Sequence[Entry], memory_types: Sequence[str], shaded: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    fill = "none" if all(entry.published for entry in entries) else None
    handles: dict[str, Any] = {}
    for name in memory_types:
        colour, marker = LOOKS[name]
        handles[name] = Line2D([], [], ls="", color=colour, marker=marker, ms=5, mfc=fill)
    if _both(entries):
        handles["paper"] = Line2D([], [], ls="", marker="o", ms=5, mec=style.INK, mfc="none")
        handles["\n".join(["here", *_extents(entries)])] = Line2D(
            [], [], ls="", marker="o", ms=5, mec=style.INK, mfc=style.INK
        )
    if shaded:
        handles["high MSR, low SR"] = Patch(facecolor=SHADE)
    wide = sum(max(map(len, name.splitlines())) + 8 for name in handles) > 40 * figure.get_size_inches()[0] / 2.45
    style.legend_below(figure, list(handles.values()), list(handles), 4 if wide else len(handles))


def _extents(entries: Sequence[Entry]) -> list[str]:
    """Return how much of ours was run, where it is less than the paper's."""
    told = dict.fromkeys(f"{entry.method}: {entry.extent}" for entry in entries if entry.extent)
    alone = len({entry.method for entry in entries if not entry.published}) == 1
    return [style.words(one.partition(": ")[2] if alone else one) for one in told]


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


def _shade(place: Any) -> None:
    from matplotlib.patches import Rectangle

    corner = (HIGH_STORAGE, -4)
    place.add_patch(
        Rectangle(corner, 104 - HIGH_STORAGE, LOW_SUCCESS + 4, facecolor=SHADE, edgecolor="none", zorder=-1)
    )


def _text(found: Sequence[Point], before: str) -> str:
    r = pearson(found)
    value = "r not defined" if r is None else f"r = {r:.2f}".replace("-", "−")
    return f"{before}{value} ({len(found)} points)"
