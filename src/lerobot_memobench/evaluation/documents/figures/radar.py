"""Radar: per method the best value over replan intervals, each axis normalised by its highest (paper, appendix)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.figures import style
from lerobot_memobench.evaluation.documents.figures.entries import Axis, Entry, Identity, best_over_replan, labels_of

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
    highest = [max((row[k] for row in best.values() if row[k] is not None), default=None) for k in range(len(axes))]  # type: ignore[type-var]
    kept = [k for k, value in enumerate(highest) if value is not None]
    tops = [float(highest[k] or 0.0) for k in kept]
    shares = {whose: [_share(row[k], top) for k, top in zip(kept, tops, strict=True)] for whose, row in best.items()}
    return [axes[k] for k in kept], tops, shares


def _share(value: float | None, top: float) -> float | None:
    return None if value is None else value / top if top else 0.0


def draw(panels: Sequence[tuple[str, Sequence[Entry]]], axes: Sequence[Axis]) -> Figure:
    """Draw one radar per panel (title, rows).

    Raises:
        MemobenchError: fewer than three axes apply.
    """
    legends = [labels_of(entries).values() for _, entries in panels]
    columns = 2 if max(len(line) for told in legends for label in told for line in label.splitlines()) <= LONGEST else 1
    rows = max(sum(1 + label.count("\n") for label in told) + 1 for told in legends) / columns
    with style.look():
        height = (3.1 if columns == 2 else 3.8) + (0 if len(axes) <= 4 else 0.6) + ROW * rows
        figure = style.new_figure(3.6 * len(panels) if len(axes) <= 4 else 4.5 * len(panels), height)
        places = figure.subplots(1, len(panels), subplot_kw={"projection": "polar"}, squeeze=False)[0]
        looks = style.looks(entry.identity for _, entries in panels for entry in entries)
        for place, (title, entries) in zip(places, panels, strict=True):
            _draw_panel(place, title, entries, axes, looks, columns)
        return figure


def _draw_panel(
    place: Any,
    title: str,
    entries: Sequence[Entry],
    axes: Sequence[Axis],
    looks: Mapping[Identity, style.Line],
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
        width, label = 1.3 if published else 2.0, style.words(labels[method, published])
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
        colour = style.GRID if ring < 1 else style.FAINT
        place.plot(_closed(angles), [ring] * (len(angles) + 1), color=colour, lw=0.6, zorder=1)
    for angle in angles:
        place.plot([angle, angle], [0, 1], color=style.GRID, lw=0.6, zorder=1)


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
