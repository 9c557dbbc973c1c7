"""Figures of rollouts: how they ended, and how many got as far as each checkpoint."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise, zip_longest
from typing import TYPE_CHECKING, Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.figures.style import (
    FAINT,
    GRID,
    INK,
    OPERATION_COLOURS,
    OUTCOMES,
    Identity,
    Line,
    legend_below,
    literal,
    looks_of,
    new_figure,
    paper_style,
)
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.evaluation.report_tables import outcomes
from lerobot_memobench.evaluation.tables import OPERATION_NAMES
from lerobot_memobench.paper import failure_taxonomy, shuffled_control

if TYPE_CHECKING:
    from matplotlib.figure import Figure


NARROWEST_LABEL = 5.0
"""Per cent; in narrower parts of a bar there is no room for a figure."""

HEADING = 52
"""Characters of a line beside a bar."""

PAPER_PARTS = {
    "success": ("success", ""),
    "storage_failure": ("storage_failure", ""),
    "stale_memory_first_update": ("stale_memory", "first update"),
    "stale_memory_late": ("stale_memory", "later update"),
}
"""The paper's classes -> ours, and what it tells beyond."""

Part = tuple[str, int, str]
"""(outcome, rollouts, remark)."""


@dataclass(frozen=True)
class Bar:
    """One bar: its parts from the left.

    Attributes:
        heading: memory type or task, written before the first bar of a group. name: whose bar it is.
    """

    heading: str
    name: str
    parts: tuple[Part, ...]

    @property
    def rollouts(self) -> int:
        """How many rollouts it stands for."""
        return sum(count for _, count, _ in self.parts)


def bars(runs: Sequence[Run], by_task: bool = False) -> list[Bar]:
    """Return the bars of evaluations: all rollouts, then each memory type's, or each task's."""
    groups: dict[str, dict[str, list[str]]] = {}  # heading -> run -> tasks
    for run in runs:
        summary = run.summary
        for task, memory_type in summary.memory_type_of.items():
            groups.setdefault("all rollouts", {}).setdefault(run.name, []).append(task)
            groups.setdefault(task if by_task else memory_type, {}).setdefault(run.name, []).append(task)
    summaries = {run.name: run.summary for run in runs}
    found = []
    for heading, members in groups.items():
        for name, tasks in members.items():
            parts = tuple((outcome, count, "") for outcome, count in outcomes(summaries[name], tasks).items())
            found.append(Bar(heading, name if len(runs) > 1 else "", parts))
    return found


def paper_bar() -> Bar:
    """Return the paper's 150 rollouts of a temporal task with the checkpoints S, U, U."""
    counts = failure_taxonomy()
    parts = tuple((outcome, counts[key], remark) for key, (outcome, remark) in PAPER_PARTS.items())
    return Bar("paper, a temporal task", "", parts)


def draw_failures(found: Sequence[Bar]) -> Figure:
    """Draw bars, those of one heading together."""
    steps = [1.0 if a.heading == b.heading else 1.45 for a, b in pairwise(found)]
    places = list(accumulate(steps, initial=0.0))  # from the top
    with paper_style():
        figure = new_figure(7.0, 1.35 + 0.27 * (places[-1] + 1))
        axis = figure.subplots()
        for bar, place in zip(found, places, strict=True):
            _draw_bar(axis, bar, place)
        axis.set_ylim(places[-1] + 0.6, -0.6)
        axis.set_xlim(0, 100)
        axis.set_xlabel("rollouts, %")
        axis.set_yticks(places, [_failures_label(found, k) for k in range(len(found))])
        axis.tick_params(axis="y", length=0)
        axis.spines["left"].set_visible(False)
        _failures_legend(figure, found)
        return figure


def _failures_legend(figure: Figure, found: Sequence[Bar]) -> None:
    from matplotlib.patches import Patch

    there = {name for bar in found for name, count, _ in bar.parts if count}
    looks = {name: look for name, look in OUTCOMES.items() if name in there}
    handles = [Patch(facecolor=look.colour, hatch=look.hatch, edgecolor=INK, lw=0.5) for look in looks.values()]
    legend_below(figure, handles, [name.replace("_", " ") for name in looks], 3)


def _draw_bar(axis: Any, bar: Bar, place: float) -> None:
    left = 0.0
    for outcome, count, remark in bar.parts:
        width = 100 * count / bar.rollouts
        look = OUTCOMES[outcome]
        axis.barh(place, width, 0.8, left, color=look.colour, hatch=look.hatch, edgecolor=INK, linewidth=0.5, zorder=2)
        if width >= NARROWEST_LABEL:
            axis.text(
                left + width / 2,
                place,
                f"{width:.0f} {remark}".strip(),
                ha="center",
                va="center",
                fontsize=7,
                zorder=3,
                bbox={"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
            )
        left += width
    axis.text(101, place, f"n = {bar.rollouts:,}", ha="left", va="center", fontsize=7, color=FAINT)


def _failures_label(found: Sequence[Bar], k: int) -> str:
    bar = found[k]
    first = k == 0 or found[k - 1].heading != bar.heading
    heading = textwrap.fill(bar.heading.replace("_", " "), HEADING) if first else ""
    parts = [heading, literal(bar.name)]
    return "   ".join(part for part in parts if part)


# --- prefix completion: one panel per task (paper, ablations) ---

COLUMNS = 4


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


def draw_prefix(found: Sequence[Panel]) -> Figure:
    """Draw the panels, at most `COLUMNS` in a row: as wide as a page."""
    looks = looks_of(curve.identity for panel in found for curve in panel.curves)
    columns = min(COLUMNS, len(found))
    rows = math.ceil(len(found) / columns)
    with paper_style():
        figure = new_figure(max(1.85 * columns, 3.6), 1.8 * rows + 0.7)
        places = figure.subplots(rows, columns, sharey=True, squeeze=False)
        for place, panel in zip_longest(places.flat, found):
            if panel is None:
                place.set_visible(False)
            else:
                _draw_prefix_panel(place, panel, looks)
        for place in places[:, 0]:
            place.set_ylabel("prefix completed, %")
        _prefix_legend(figure, found, looks, columns)
        return figure


def _prefix_legend(figure: Figure, found: Sequence[Panel], looks: Mapping[Identity, Line], columns: int) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles: list[Any] = [Line2D([], [], **look.drawn, ms=4, lw=1.3) for look in looks.values()]
    labels = [literal(f"paper, {name}" if published else name) for name, published in looks]
    if any(curve.ordered not in (None, curve.plain) for panel in found for curve in panel.curves):
        handles.append(Line2D([], [], color=FAINT, marker="o", mfc="white", ls=":", ms=4, lw=1.0))
        labels.append("in order, where it differs")
    asked = {operation for panel in found for operation in panel.operations}
    for operation, name in OPERATION_NAMES.items():
        if operation in asked:
            handles.append(Patch(facecolor=OPERATION_COLOURS[operation]))
            labels.append(f"{operation}: {name.lower()}")
    legend_below(figure, handles, labels, min(len(handles), 2 if columns < 3 else 3 if len(looks) % 2 else 4))


def _draw_prefix_panel(place: Any, panel: Panel, looks: Mapping[Identity, Line]) -> None:
    for curve in panel.curves:
        _draw_curve(place, curve, looks[curve.identity], shaded=len(panel.curves) <= 3)
    place.set_title(textwrap.fill(panel.title, 30), fontsize=7, fontweight="normal")
    place.set_ylim(0, 102)
    place.set_yticks(range(0, 101, 25))
    place.grid(axis="y", color=GRID, lw=0.5)
    place.set_xlim(-0.4, len(panel.operations) - 0.6)
    place.set_xticks(range(len(panel.operations)), list(panel.operations))
    for label, operation in zip(place.get_xticklabels(), panel.operations, strict=True):
        label.set_bbox({"boxstyle": "round,pad=0.2", "facecolor": OPERATION_COLOURS[operation], "edgecolor": "none"})
    place.tick_params(axis="x", length=0, pad=5)


def _draw_curve(place: Any, curve: Curve, look: Line, shaded: bool) -> None:
    """Draw the rates, their intervals where ``shaded``, and the rates in order where they differ."""
    steps = range(len(curve.plain))
    if curve.low is not None and curve.high is not None and shaded:
        place.fill_between(steps, curve.low, curve.high, color=look.colour, alpha=0.12, lw=0, zorder=1)
    place.plot(steps, curve.plain, **look.drawn, ms=4, lw=1.3, zorder=3, clip_on=False)
    if curve.ordered is not None and curve.ordered != curve.plain:
        dotted = look.drawn | {"ls": ":", "mfc": "white"}
        place.plot(steps, curve.ordered, **dotted, ms=3, lw=0.9, zorder=4, clip_on=False)
