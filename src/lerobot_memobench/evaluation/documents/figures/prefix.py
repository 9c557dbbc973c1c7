"""Prefix completion: how many rollouts got as far as each checkpoint, one panel per task (paper, ablations)."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.figures import style
from lerobot_memobench.evaluation.documents.figures.entries import Identity
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import shuffled_control

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLUMNS = 5


@dataclass(frozen=True)
class Curve:
    """Per cent of rollouts per checkpoint.

    Attributes:
        ordered: the same, counting only what came in order; None where it is not known.
        low, high: Wilson's interval of ``plain``; None where n is not known.
        published: whether it is the paper's.
    """

    name: str
    plain: tuple[float, ...]
    ordered: tuple[float, ...] | None = None
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None
    published: bool = False

    @property
    def identity(self) -> Identity:
        """Whose curve it is."""
        return self.name, self.published


@dataclass(frozen=True)
class Panel:
    """The curves of one task; ``operations`` are its checkpoints' labels."""

    title: str
    operations: str
    curves: tuple[Curve, ...]


def panels(runs: Sequence[Run], tasks: Sequence[str] | None = None) -> list[Panel]:
    """Return one panel per task that any of the evaluations ran, or per task chosen.

    Raises:
        MemobenchError: a task that was chosen was not evaluated, or differs between the evaluations.
    """
    there = list(dict.fromkeys(name for run in runs for name in run.summary.tasks))
    for name in tasks or ():
        if name not in there:
            raise MemobenchError(f"the task {name!r} was not evaluated here; choose among those of the report")
    found = []
    for name in there:
        if tasks is not None and name not in tasks:
            continue
        members = [run for run in runs if name in run.summary.tasks]
        operations = {run.summary.operations_of[name] for run in members}
        if len(operations) > 1:
            raise MemobenchError(f"the evaluations ran different versions of {name!r}; draw them separately")
        found.append(Panel(name.replace("_", " "), operations.pop(), tuple(_curve(run, name) for run in members)))
    return found


def _curve(run: Run, task: str) -> Curve:
    rates = run.summary.prefix[task]
    intervals = [rate.interval or (0.0, 1.0) for rate in rates]
    return Curve(
        run.name,
        tuple(math.nan if rate.value is None else 100 * rate.value for rate in rates),
        tuple(math.nan if rate.value is None else 100 * rate.value for rate in run.summary.ordered_prefix[task]),
        tuple(100 * low for low, _ in intervals),
        tuple(100 * high for _, high in intervals),
    )


def paper_panel() -> Panel:
    """Return the paper's shuffled memory control: its temporal task with the checkpoints S, U, U."""
    curves = shuffled_control()
    return Panel(
        "paper, a temporal task: subgoals in order and shuffled",
        "SUU",
        tuple(Curve(name, tuple(values), published=True) for name, values in curves.items()),
    )


def draw(found: Sequence[Panel]) -> Figure:
    """Draw the panels, at most five in a row."""
    looks = style.looks(curve.identity for panel in found for curve in panel.curves)
    columns = min(COLUMNS, len(found))
    rows = math.ceil(len(found) / columns)
    with style.look():
        figure = style.new_figure(max(2.1 * columns, 3.6), 1.9 * rows + 0.6)
        places = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for place, panel in zip_longest(places.flat, found):
            if panel is None:
                place.set_visible(False)
            else:
                _draw_panel(place, panel, looks)
        for place in places[:, 0]:
            place.set_ylabel("prefix, %")
        _legend(figure, found, looks, columns)
        return figure


def _legend(figure: Figure, found: Sequence[Panel], looks: Mapping[Identity, style.Line], columns: int) -> None:
    from matplotlib.lines import Line2D

    handles = [Line2D([], [], **look.drawn, ms=4, lw=1.3) for look in looks.values()]
    labels = [style.words(f"paper, {name}" if published else name) for name, published in looks]
    if any(curve.ordered not in (None, curve.plain) for panel in found for curve in panel.curves):
        handles.append(Line2D([], [], color=style.FAINT, marker="o", mfc="white", ls=":", ms=4, lw=1.0))
        labels.append("in order, where it differs")
    style.legend_below(figure, handles, labels, min(len(handles), 2 if columns < 3 else 4))


def _draw_panel(place: Any, panel: Panel, looks: Mapping[Identity, style.Line]) -> None:
    for curve in panel.curves:
        _draw_curve(place, curve, looks[curve.identity], shaded=len(panel.curves) <= 3)
    place.set_title(textwrap.fill(panel.title, 34, max_lines=3, placeholder=" …"), fontsize=6.5, fontweight="normal")
    place.set_ylim(0, 102)
    place.set_yticks(range(0, 101, 25))
    place.grid(axis="y", color=style.GRID, lw=0.5)
    place.set_xlim(-0.4, len(panel.operations) - 0.6)
    place.set_xticks(range(len(panel.operations)), list(panel.operations))
    for label, operation in zip(place.get_xticklabels(), panel.operations, strict=True):
        label.set_bbox(
            {"boxstyle": "round,pad=0.2", "facecolor": style.OPERATION_COLOURS[operation], "edgecolor": "none"}
        )
    place.tick_params(axis="x", length=0, pad=5)


def _draw_curve(place: Any, curve: Curve, look: style.Line, shaded: bool) -> None:
    """Draw the rates, their intervals where ``shaded``, and the rates in order where they differ."""
    steps = range(len(curve.plain))
    if curve.low is not None and curve.high is not None and shaded:
        place.fill_between(steps, curve.low, curve.high, color=look.colour, alpha=0.12, lw=0, zorder=1)
    place.plot(steps, curve.plain, **look.drawn, ms=4, lw=1.3, zorder=3, clip_on=False)
    if curve.ordered is not None and curve.ordered != curve.plain:
        dotted = look.drawn | {"ls": ":", "mfc": "white"}
        place.plot(steps, curve.ordered, **dotted, ms=3, lw=0.9, zorder=4, clip_on=False)
