"""Figures of a report: outcomes of rollouts as bars, rates by replan interval, and success by gap.

Colours are safe for the colour-blind; hatches, markers and dashes keep them apart in grey. Operations have the colours
of videos and of the HTML report (Okabe and Ito's palette). The figures of the paper are drawn by
``examples/paper/figures.py``.
"""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from itertools import accumulate, pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lerobot_memobench.envs.video import OPERATION_COLOURS as VIDEO_COLOURS
from lerobot_memobench.evaluation.metrics import METRICS, Rate, Record
from lerobot_memobench.evaluation.records import Run, sweeps
from lerobot_memobench.evaluation.report import outcomes
from lerobot_memobench.io import draft_of
from lerobot_memobench.tasks.catalogue import cue_to_use, get_task, suite_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

OPERATION_COLOURS = {key: "#" + bytes(colour).hex() for key, colour in VIDEO_COLOURS.items()}
INK, FAINT, GRID = "#222222", "#777777", "#d9d9d9"

OUTCOMES = {
    "success": ("#e8e8e8", ""),
    "storage_failure": (OPERATION_COLOURS["S"], "////"),
    "stale_memory": (OPERATION_COLOURS["U"], "\\\\\\\\"),
    "compression_collapse": (OPERATION_COLOURS["C"], "...."),
    "reference_drift": ("#f0e442", "||||"),
    "execution_failure": ("#d55e00", "xxxx"),
    "wrong_order": ("#c2a878", "\\\\||"),
    "cut_off": ("#bdbdbd", "--"),
    "miscount": ("#cc79a7", "++++"),
    "wrong_place": ("#8a8a8a", "oooo"),
    "hand": ("#e6a176", "xx"),
    "invalid_action": ("#b39ddb", "OO"),
    "unstable_physics": ("#b39ddb", "**"),
}
"""Outcome -> colour, as in the HTML report, and hatch."""

_COLOURS = (
    "#0072b2", "#d55e00", "#000000", "#cc79a7", "#882255", "#999933", "#777777", "#332288", "#44aa99", "#aa4499",
    "#661100",
)  # fmt: skip
"""Okabe and Ito's without those of the operations, then Paul Tol's muted ones."""
_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*", "<", "h", ">")
_DASHES: tuple[Any, ...] = (
    "-", "--", "-.", ":",
    (0, (5, 1)), (0, (3, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (4, 1, 1, 1, 1, 1)), (0, (2, 2)),
    (0, (6, 1, 1, 1)),
)  # fmt: skip


def line_style(number: int, published: bool) -> dict[str, Any]:
    """Return matplotlib's keywords of the line of a method; the paper's have open markers."""
    size = len(_COLOURS)
    # A method beyond the last colour gets another marker with it.
    colour, other = _COLOURS[number % size], (number + number // size) % size
    face = "white" if published else colour
    return {"color": colour, "marker": _MARKERS[other], "ls": _DASHES[other], "mfc": face, "ms": 4}


def paper_style() -> AbstractContextManager[None]:
    """Return a context that sets fonts and lines of everything drawn inside."""
    import matplotlib as mpl

    settings = {
        "font.size": 8,
        "axes.titlesize": 8.5,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": FAINT,
        "axes.linewidth": 0.7,
        "xtick.color": INK,
        "ytick.color": INK,
        "text.color": INK,
        "legend.frameon": False,
        "hatch.linewidth": 0.4,
        "pdf.fonttype": 42,  # text stays text
    }
    return mpl.rc_context(settings)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out without overlaps."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def literal(name: str) -> str:
    """Return a name as matplotlib sets it: the models π0 and π0.5 with an index, everything else literally."""
    return re.sub(r"π(\d(?:\.\d)?)", r"$\\pi_{\1}$", name.replace("$", r"\$"))


def legend_below(figure: Figure, handles: Mapping[str, Any], columns: int) -> None:
    """Put one legend, label -> handle, under all panels."""
    labels = [literal(label) for label in handles]
    figure.legend(list(handles.values()), labels, loc="outside lower center", ncols=columns, handlelength=3.2)


def save(figure: Figure, folder: Path, name: str) -> list[Path]:
    """Write a figure as ``name``.pdf and ``name``.png into a folder; return the files."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.pdf", folder / f"{name}.png"]
    for path in paths:
        # Without its date, the same figure is the same file.
        metadata = {"CreationDate": None} if path.suffix == ".pdf" else None
        with draft_of(path) as draft, paper_style():
            figure.savefig(draft, dpi=200, metadata=metadata)
    return paths


def draw_figures(runs: Sequence[Run], folder: Path) -> list[Path]:
    """Draw the figures of a report into a folder; return the files."""
    files = save(draw_outcomes(bars(runs)), folder, "outcomes")
    if sweeps(runs):
        files += save(draw_replan(runs), folder, "replan")
    by_gap = {run.name: success_by_gap(run.records) for run in runs}
    if any(by_gap.values()):
        files += save(draw_gaps(by_gap), folder, "gap")
    return files


# --- outcomes of rollouts ---

NARROWEST_LABEL = 5.0  # per cent; narrower parts of a bar have no room for a number
HEADING = 52  # characters of a line left of a bar


class Bar(NamedTuple):
    """The outcomes of an evaluation, outcome -> rollouts, under the heading of a group of bars."""

    heading: str
    name: str
    parts: Mapping[str, int]


def bars(runs: Sequence[Run]) -> list[Bar]:
    """Return the bars of all rollouts, then of each memory type."""
    types = dict.fromkeys(task.memory_type for run in runs for task in run.summary.tasks.values())
    return [
        Bar(heading, run.name if len(runs) > 1 else "", outcomes(run.summary, tasks))
        for heading in ("all rollouts", *types)
        for run in runs
        if (tasks := [*run.summary.tasks] if heading == "all rollouts" else run.summary.tasks_of(heading))
    ]


def draw_outcomes(rows: Sequence[Bar]) -> Figure:
    """Draw bars, those of one heading together."""
    from matplotlib.patches import Patch

    steps = [1.0 if a.heading == b.heading else 1.45 for a, b in pairwise(rows)]
    heights = list(accumulate(steps, initial=0.0))  # from the top
    headings = ["", *(bar.heading for bar in rows)]  # that of the previous bar
    with paper_style():
        figure = new_figure(7.0, 1.35 + 0.27 * (heights[-1] + 1))
        axis = figure.subplots()
        labels = []
        for bar, height, previous in zip(rows, heights, headings, strict=False):
            _draw_bar(axis, bar, height)
            heading = "" if bar.heading == previous else textwrap.fill(bar.heading, HEADING)
            labels.append("   ".join(part for part in (heading, literal(bar.name)) if part))
        axis.set_ylim(heights[-1] + 0.6, -0.6)
        axis.set_xlim(0, 100)
        axis.set_xlabel("rollouts, %")
        axis.set_yticks(heights, labels)
        axis.tick_params(axis="y", length=0)
        axis.spines["left"].set_visible(False)
        counted = {name for bar in rows for name, count in bar.parts.items() if count}
        handles = {
            name.replace("_", " "): Patch(facecolor=colour, hatch=hatch, edgecolor=INK, lw=0.5)
            for name, (colour, hatch) in OUTCOMES.items()
            if name in counted
        }
        legend_below(figure, handles, 3)
        return figure


def _draw_bar(axis: Any, bar: Bar, height: float) -> None:
    left, rollouts = 0.0, sum(bar.parts.values())
    for outcome, count in bar.parts.items():
        width = 100 * count / rollouts
        colour, hatch = OUTCOMES[outcome]
        axis.barh(height, width, 0.8, left, color=colour, hatch=hatch, edgecolor=INK, linewidth=0.5, zorder=2)
        if width >= NARROWEST_LABEL:
            box = {"boxstyle": "round,pad=0.15", "facecolor": "white", "edgecolor": "none", "alpha": 0.85}
            axis.text(left + width / 2, height, f"{width:.0f}", ha="center", va="center", size=7, zorder=3, bbox=box)
        left += width
    axis.text(101, height, f"n = {rollouts:,}", ha="left", va="center", size=7, color=FAINT)


# --- rates by replan interval ---


def draw_replan(runs: Sequence[Run]) -> Figure:
    """Draw each metric on average over replan intervals, a line per method, with Wilson's intervals."""
    from matplotlib.lines import Line2D

    metrics = [*runs[0].summary.average]
    methods = {
        name: {
            metric: {
                run.replan_steps: rate
                for run in group
                if (rate := run.summary.average[metric]).value is not None and run.replan_steps is not None
            }
            for metric in metrics
        }
        for name, group in sweeps(runs).items()
    }
    styles = {name: line_style(number, published=False) for number, name in enumerate(methods)}
    with paper_style():
        figure = new_figure(1.25 + 1.55 * len(metrics), 2.5)
        for metric, axis in zip(metrics, figure.subplots(1, len(metrics), squeeze=False)[0], strict=True):
            for name, curves in methods.items():
                _draw_curve(axis, curves[metric], styles[name])
            axis.set_title(f"{metric} ({METRICS[metric].title})", fontsize=7.5)
            axis.set_xlabel("replan interval, steps")
            axis.set_xticks(sorted({steps for curves in methods.values() for steps in curves[metric]}))
            # Room for markers at the top, and at least ten points of scale: noise is not to look like a trend.
            axis.set_ylim(bottom=0)
            axis.set_ylim(top=min(102.0, max(10.0, axis.get_ylim()[1])))
            axis.grid(axis="y", color=GRID, lw=0.5)
        figure.axes[0].set_ylabel("average, %")
        legend_below(figure, {name: Line2D([], [], **styles[name]) for name in methods}, 3)
        return figure


def _draw_curve(axis: Any, curve: Mapping[int, Rate], style: Mapping[str, Any]) -> None:
    values = [math.nan if rate.value is None else 100 * rate.value for rate in curve.values()]
    intervals = [rate.interval for rate in curve.values() if rate.interval is not None]
    if intervals:
        low, high = ([100 * interval[k] for interval in intervals] for k in (0, 1))
        axis.fill_between(list(curve), low, high, color=style["color"], alpha=0.15, lw=0, zorder=1)
    axis.plot(list(curve), values, **style, lw=1.9 if intervals else 1.1, zorder=3, clip_on=False)


# --- success by gap ---

# The first group needs no memory over time.
EDGES = (0, 2, 64, 128, 256, 512, 1024, 2048, 4096, 8192)
GAPS = {f"{low}–{high - 1}": (low, high) for low, high in pairwise(EDGES)}
"""Groups of gaps from cue to use (`catalogue.cue_to_use`), control steps."""


def success_by_gap(records: Sequence[Record]) -> dict[str, tuple[int, int]]:
    """Return for each group of gaps with checkpoints how many were reached, and how many there are."""
    samples = [sample for record in records for sample in _samples(record)]
    reached = {group: [done for gap, done in samples if low <= gap < high] for group, (low, high) in GAPS.items()}
    return {group: (sum(done), len(done)) for group, done in reached.items() if done}


def _samples(record: Record) -> Iterator[tuple[int, bool]]:
    """Yield gap and success of the checkpoints that an episode came to; none for tasks without measured gaps.

    Only where all earlier ones were reached in order, the information of a checkpoint had to be remembered.
    """
    if suite_of(record["task"]) is None:
        return
    task = get_task(record["task"])
    for gap, checkpoint in zip(cue_to_use(task), record["checkpoints"], strict=False):
        steps = 0 if gap is None else gap.median
        reached = checkpoint.get("ordered_step") is not None
        yield steps, reached
        if not reached:
            return


def draw_gaps(by_gap: Mapping[str, Mapping[str, tuple[int, int]]]) -> Figure:
    """Draw the rate of reached checkpoints over their gap, given the `success_by_gap` of each evaluation."""
    from matplotlib.lines import Line2D

    groups = [group for group in GAPS if any(group in counts for counts in by_gap.values())]
    styles = {name: line_style(number, published=False) for number, name in enumerate(by_gap)}
    with paper_style():
        figure = new_figure(5.0, 2.7)
        axis = figure.subplots()
        for name, counts in by_gap.items():
            curve = {groups.index(group): Rate(done / count, count) for group, (done, count) in counts.items()}
            _draw_curve(axis, curve, styles[name])
        axis.set_xticks(range(len(groups)), groups)
        axis.set_xlabel("gap from cue to use, control steps")
        axis.set_ylabel("checkpoints reached, %")
        axis.set_ylim(0, 102)
        axis.grid(axis="y", color=GRID, lw=0.5)
        legend_below(figure, {name: Line2D([], [], **styles[name]) for name in by_gap}, 3)
        return figure
