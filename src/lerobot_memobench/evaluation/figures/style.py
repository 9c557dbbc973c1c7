"""One look for all figures: safe for the colour-blind, and told apart in grey by marker, line and hatch.

Operations keep the colours they have in videos and in the HTML report (Okabe and Ito's palette); what else needs colour
takes others.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_memobench.envs.video import OPERATION_COLOURS as VIDEO_COLOURS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import METRICS, Row
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.evaluation.report_tables import PAPER_EPISODES, PAPER_INPUTS, PAPER_TASKS, extent
from lerobot_memobench.io import count_of, draft_of
from lerobot_memobench.paper import published_rows, shuffled_control
from lerobot_memobench.tasks.task import MEMORY_TYPES

if TYPE_CHECKING:
    from matplotlib.figure import Figure


OPERATION_COLOURS = {key: "#" + bytes(colour).hex() for key, colour in VIDEO_COLOURS.items()}
METRIC_NAMES = {"SR": "success", "MSR": "storage", "MUR": "update", "MCR": "compression"}

INK, FAINT, GRID = "#222222", "#777777", "#d9d9d9"


@dataclass(frozen=True)
class Look:
    """How one kind of rollouts is filled: colour, and hatch for print in grey."""

    colour: str
    hatch: str = ""


OUTCOMES: dict[str, Look] = {
    "success": Look("#e8e8e8"),
    "storage_failure": Look(OPERATION_COLOURS["S"], "////"),
    "stale_memory": Look(OPERATION_COLOURS["U"], "\\\\\\\\"),
    "compression_collapse": Look(OPERATION_COLOURS["C"], "...."),
    "reference_drift": Look("#f0e442", "||||"),
    "execution_failure": Look("#d55e00", "xxxx"),
    "wrong_order": Look("#c2a878", "\\\\||"),
    "cut_off": Look("#bdbdbd", "--"),
    "miscount": Look("#cc79a7", "++++"),
    "wrong_place": Look("#8a8a8a", "oooo"),
    "invalid_action": Look("#b39ddb", "OO"),
    "unstable_physics": Look("#b39ddb", "**"),
}
"""Outcome -> look; the colours are those of the HTML report."""


@dataclass(frozen=True)
class Line:
    """How one method is drawn."""

    colour: str
    marker: str
    dashes: Any
    open: bool = False

    @property
    def drawn(self) -> dict[str, Any]:
        """The same as matplotlib's keywords."""
        face = "white" if self.open else self.colour
        return {"color": self.colour, "marker": self.marker, "ls": self.dashes, "mfc": face}


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


def looks_of(identities: Iterable[tuple[str, bool]]) -> dict[tuple[str, bool], Line]:
    """Return a look for each (method, whether it is the paper's).

    No two of eleven evaluations share colour, marker or dashes, no two of a hundred all three.
    A method of the paper's has the same one in every figure, from the palette's end; evaluations take theirs from its
    beginning, as they are named. The paper's markers are open, so that they are told apart also where colours repeat.
    """
    number = count()
    return {
        (name, published): _papers_line(name) if published else _line(next(number))
        for name, published in dict.fromkeys(identities)
    }


def _line(k: int) -> Line:
    size = len(_COLOURS)
    return Line(_COLOURS[k % size], _MARKERS[(k + k // size) % size], _DASHES[(k + k // size) % size])


def _papers_line(name: str) -> Line:
    known = list(dict.fromkeys((*(row.label for row in published_rows()), *shuffled_control())))
    return replace(_line(len(_COLOURS) - 1 - known.index(name) % len(_COLOURS)), open=True)


@contextmanager
def paper_style() -> Iterator[None]:
    """Set fonts and lines for everything drawn inside."""
    import matplotlib as mpl

    settings = {
        "font.size": 8,
        "axes.titlesize": 8.5,
        "axes.labelsize": 8,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.edgecolor": FAINT,
        "axes.linewidth": 0.7,
        "axes.titleweight": "bold",
        "xtick.color": INK,
        "ytick.color": INK,
        "xtick.major.width": 0.7,
        "ytick.major.width": 0.7,
        "text.color": INK,
        "legend.frameon": False,
        "legend.fontsize": 8,
        "hatch.linewidth": 0.4,
        "pdf.fonttype": 42,  # text stays text
        "svg.fonttype": "none",
    }
    with mpl.rc_context(settings):
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of a size in inches, laid out so that nothing overlaps."""
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    return Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.06))


def literal(name: str) -> str:
    """Return a name as matplotlib sets it: the models π0 and π0.5 with an index, everything else literally."""
    literal = name.replace("$", r"\$")
    return re.sub(r"π(\d(?:\.\d)?)", r"$\\pi_{\1}$", literal)


def legend_below(figure: Figure, handles: Sequence[Any], labels: Sequence[str], columns: int) -> None:
    """Put one legend under all panels."""
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, handlelength=3.2, columnspacing=1.6)


FORMATS = (".pdf", ".png", ".svg")


def save(figure: Figure, out: Path, name: str) -> list[Path]:
    """Write a figure to a file whose ending says as what, or as NAME.pdf and NAME.png into a folder; return the files.

    Raises:
        MemobenchError: the ending is none of .pdf, .png, .svg.
    """
    if out.suffix and not out.is_dir():
        if out.suffix.lower() not in FORMATS:
            raise MemobenchError(f"--out {out} ends in {out.suffix}; expected {', '.join(FORMATS)}, or a folder")
        paths = [out]
    else:
        paths = [out / f"{name}.pdf", out / f"{name}.png"]
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
        # Without its date, the same figures give the same file.
        metadata = {".pdf": {"CreationDate": None}, ".svg": {"Date": None}}.get(path.suffix.lower())
        with draft_of(path) as draft:
            figure.savefig(draft, dpi=200, metadata=metadata, bbox_inches="tight", pad_inches=0.06)
    return paths


# --- the rows that figures are drawn from: one method at one replan interval, ours or the paper's alike ---

Identity = tuple[str, bool]
"""(method, whether it is the paper's)."""

Figures = Mapping[str, float | None]
"""Metric -> per cent; None where it does not apply."""


@dataclass(frozen=True)
class Entry:
    """One method at one replan interval.

    Attributes:
        memory_types, tasks: name -> figures; the paper publishes none per task. published: whether it is the paper's.
        remarks: what a legend says of it beside others (`remarks_on`).
    """

    method: str
    replan_steps: int | None
    memory_types: Mapping[str, Figures]
    average: Figures
    tasks: Mapping[str, Figures]
    memory_type_of: Mapping[str, str]
    published: bool = False
    remarks: tuple[str, ...] = ()

    @property
    def identity(self) -> Identity:
        """Whose row it is, whatever stands beside: an evaluation may be called like one of the paper's methods."""
        return self.method, self.published


def entries_of(runs: Sequence[Run]) -> list[Entry]:
    """Return the rows of evaluations."""
    found = []
    for run in runs:
        summary = run.summary
        types = {name: _figures(row) for name, row in summary.memory_types.items()}
        tasks = {name: _figures(row) for name, row in summary.tasks.items()}
        found.append(
            Entry(
                run.method,
                run.replan_steps,
                types,
                _figures(summary.average),
                tasks,
                summary.memory_type_of,
                remarks=remarks_on(run),
            )
        )
    return found


def remarks_on(run: Run) -> tuple[str, ...]:
    """Return how much was run and the policy's inputs, each where it is not the paper's."""
    inputs = "" if run.summary.inputs == PAPER_INPUTS else f"inputs: {run.summary.inputs}"
    return tuple(filter(None, (extent(run), inputs)))


def caption(runs: Sequence[Run], paper: bool) -> str:
    """Return what a figure does not say of its rows: tasks, rollouts, and the policies' inputs."""
    rows = [
        f"{run.name}: {count_of(len(run.summary.tasks), 'task')}, {count_of(run.summary.rollouts, 'rollout')}, inputs: "
        f"{run.summary.inputs}"
        for run in runs
    ]
    if paper:
        rows.append(
            f"paper: {PAPER_TASKS} tasks, {PAPER_TASKS * PAPER_EPISODES:,} rollouts each, inputs: {PAPER_INPUTS}"
        )
    return "; ".join(rows)


def with_remarks(name: str, remarks: Iterable[tuple[str, ...]]) -> str:
    """Return a name for a legend, and on further lines the remarks on its rows."""
    told = ";\n".join(dict.fromkeys(chain.from_iterable(remarks)))
    return f"{name}\n({told})" if told else name


def published_entries(*tables: str) -> list[Entry]:
    """Return the rows of some of the paper's tables."""
    return [
        Entry(row.label, row.replan_steps, row.memory_types, row.average, {}, {}, published=True)
        for row in published_rows(*tables)
    ]


def _figures(row: Row) -> dict[str, float | None]:
    return {metric: None if (value := row[metric].value) is None else 100 * value for metric in METRICS}


Axis = tuple[str | None, str]
"""(memory type, metric); None for the average."""
AVERAGE_AXES: list[Axis] = [(None, metric) for metric in METRICS]
TYPE_AXES: list[Axis] = [(memory_type, metric) for memory_type in MEMORY_TYPES for metric in METRICS]


def best_over_replan(entries: Iterable[Entry], axes: Sequence[Axis]) -> dict[Identity, list[float | None]]:
    """Return whose row -> per axis the highest figure over its replan intervals (the paper's rule for its radar)."""
    found: dict[Identity, list[float | None]] = {}
    for entry in entries:
        row = found.setdefault(entry.identity, [None] * len(axes))
        for k, (memory_type, metric) in enumerate(axes):
            figures = entry.average if memory_type is None else entry.memory_types.get(memory_type, {})
            value, so_far = figures.get(metric), row[k]
            if value is not None and (so_far is None or value > so_far):
                row[k] = value
    return found


def labels_of(entries: Sequence[Entry]) -> dict[Identity, str]:
    """Return what a row is called in a legend.

    Beside one another the paper's say so. Ours carry their remarks where these differ: beside the paper's, or when
    evaluations were run unlike.
    """
    beside = len({entry.published for entry in entries}) > 1
    remarks: dict[Identity, list[tuple[str, ...]]] = {}
    for entry in entries:
        remarks.setdefault(entry.identity, []).append(entry.remarks)
    differ = len({row for told in remarks.values() for row in told}) > 1
    return {
        (method, published): f"paper: {method}"
        if published and beside
        else with_remarks(method, told if differ else ())
        for (method, published), told in remarks.items()
    }
