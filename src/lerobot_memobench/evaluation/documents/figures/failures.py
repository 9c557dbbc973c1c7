"""How rollouts ended: one bar per evaluation and memory type, filled by outcome (paper, failure mode taxonomy)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import TYPE_CHECKING, Any

from lerobot_memobench.evaluation.documents.evaluation_tables import outcomes
from lerobot_memobench.evaluation.documents.figures import style
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.paper import failure_taxonomy

if TYPE_CHECKING:
    from matplotlib.figure import Figure

NARROWEST_LABEL = 5.0
"""Per cent; in narrower parts of a bar there is no room for a figure."""

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
    named = {run.name: run for run in runs}
    return [
        Bar(heading, name if len(runs) > 1 else "", _parts(named[name], tasks))
        for heading, members in groups.items()
        for name, tasks in members.items()
    ]


def _parts(run: Run, tasks: Sequence[str]) -> tuple[Part, ...]:
    return tuple((name, count, "") for name, count in outcomes(run.summary, tasks).items())


def paper_bar() -> Bar:
    """Return the paper's 150 rollouts of a temporal task with the checkpoints S, U, U."""
    counts = failure_taxonomy()
    parts = tuple((outcome, counts[key], remark) for key, (outcome, remark) in PAPER_PARTS.items())
    return Bar("paper, a temporal task", "", parts)


def draw(found: Sequence[Bar]) -> Figure:
    """Draw bars, those of one heading together."""
    places = _places(found)
    with style.look():
        figure = style.new_figure(7.0, 1.35 + 0.27 * (places[-1] + 1))
        axis = figure.subplots()
        for bar, place in zip(found, places, strict=True):
            _draw_bar(axis, bar, place)
        axis.set_ylim(places[-1] + 0.6, -0.6)
        axis.set_xlim(0, 100)
        axis.set_xlabel("rollouts, %")
        axis.set_yticks(places, [_label(found, k) for k in range(len(found))])
        axis.tick_params(axis="y", length=0)
        axis.spines["left"].set_visible(False)
        _legend(figure, found)
        return figure


def _places(found: Sequence[Bar]) -> list[float]:
    """Return where each bar lies, from the top."""
    steps = [1.0 if a.heading == b.heading else 1.45 for a, b in pairwise(found)]
    return list(accumulate(steps, initial=0.0))


def _legend(figure: Figure, found: Sequence[Bar]) -> None:
    from matplotlib.patches import Patch

    there = {name for bar in found for name, count, _ in bar.parts if count}
    looks = {name: look for name, look in style.OUTCOMES.items() if name in there}
    handles = [Patch(facecolor=look.colour, hatch=look.hatch, edgecolor=style.INK, lw=0.5) for look in looks.values()]
    style.legend_below(figure, handles, [name.replace("_", " ") for name in looks], 3)


def _draw_bar(axis: Any, bar: Bar, place: float) -> None:
    left = 0.0
    for outcome, count, remark in bar.parts:
        width = 100 * count / bar.rollouts
        look = style.OUTCOMES[outcome]
        axis.barh(
            place, width, 0.8, left, color=look.colour, hatch=look.hatch, edgecolor=style.INK, linewidth=0.5, zorder=2
        )
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
    axis.text(101, place, f"n = {bar.rollouts:,}", ha="left", va="center", fontsize=7, color=style.FAINT)


def _label(found: Sequence[Bar], k: int) -> str:
    bar = found[k]
    first = k == 0 or found[k - 1].heading != bar.heading
    heading = bar.heading.replace("_", " ") if first else ""
    if len(heading) > 46:
        heading = heading[:45] + "…"
    parts = [heading, style.words(bar.name)]
    return "   ".join(part for part in parts if part)
