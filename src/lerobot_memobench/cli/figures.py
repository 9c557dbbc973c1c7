"""``memobench figures …``: one command per figure of the paper, from evaluations, from its tables, or from both."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import say
from lerobot_memobench.cli.report import Folders, With, given_runs
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.task import PUBLISHED

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from lerobot_memobench.evaluation.records import Run

app = typer.Typer(
    help="Draw figures of evaluations and of the paper's tables. Evaluations: DIR, or NAME=DIR; the paper's: --with "
    "paper. As PDF and PNG.",
    no_args_is_help=True,
)

Out = Annotated[
    Path, typer.Option(help="A file ending in .pdf, .png or .svg, or a folder that gets the PDF and the PNG.")
]
DEFAULT_OUT = Path("outputs/figures")


class Axes(StrEnum):
    """What the axes of a radar are."""

    AVERAGE = "average"
    TYPES = "types"


class Grouping(StrEnum):
    """What one point, bar or row of panels is about."""

    TYPES = "types"
    TASKS = "tasks"


@app.command()
def radar(
    folders: Folders = None,
    with_: With = None,
    axes: Annotated[
        Axes, typer.Option(help="average: SR, MSR, MUR, MCR; types: those of each memory type.")
    ] = Axes.AVERAGE,
    out: Out = DEFAULT_OUT,
) -> None:
    """Per method the best value over replan intervals, each axis normalised by its highest."""
    from lerobot_memobench.evaluation.figures.rates import draw_radar
    from lerobot_memobench.evaluation.figures.style import AVERAGE_AXES, TYPE_AXES, entries_of, published_entries

    runs, paper = given_runs(folders, with_)
    ours = entries_of(runs)
    chosen = AVERAGE_AXES if axes is Axes.AVERAGE else TYPE_AXES
    webs = [("", ours)]
    if paper:
        webs = [
            ("Main results", [*ours, *published_entries("main")]),
            ("Memory alignment", [*ours, *published_entries("alignment")]),
        ]
    _save(draw_radar(webs, chosen), out, "radar" if axes is Axes.AVERAGE else "radar_types", runs, paper)


@app.command()
def correlations(
    folders: Folders = None,
    with_: With = None,
    by: Annotated[
        Grouping | None,
        typer.Option(help="One point per memory type or per task; per task where only evaluations are drawn."),
    ] = None,
    out: Out = DEFAULT_OUT,
) -> None:
    """MSR, MUR and MCR against SR with Pearson's r."""
    from lerobot_memobench.evaluation.figures.rates import draw_correlations
    from lerobot_memobench.evaluation.figures.style import entries_of, published_entries

    runs, paper = given_runs(folders, with_)
    if paper and by is Grouping.TASKS:
        raise MemobenchError("the paper publishes no figures per task; leave out --by tasks or --with paper")
    rows = [*(published_entries("main") if paper else ()), *entries_of(runs)]
    by_task = by is Grouping.TASKS or (by is None and not paper)
    _save(draw_correlations(rows, by_task), out, "correlations", runs, paper)


@app.command()
def failures(
    folders: Folders = None,
    with_: With = None,
    by: Annotated[Grouping, typer.Option(help="One bar per memory type or per task.")] = Grouping.TYPES,
    out: Out = DEFAULT_OUT,
) -> None:
    """How rollouts ended: success and the classes of failure, as bars."""
    from lerobot_memobench.evaluation.figures.rollouts import bars, draw_failures, paper_bar

    runs, paper = given_runs(folders, with_)
    drawn = [*bars(runs, by is Grouping.TASKS), *([paper_bar()] if paper else [])]
    _save(draw_failures(drawn), out, "failures", runs, paper=False)


@app.command()
def prefix(
    folders: Folders = None,
    with_: With = None,
    tasks: Annotated[
        str | None, typer.Option(help="Tasks to draw: memory types or names, separated by commas; all by default.")
    ] = None,
    out: Out = DEFAULT_OUT,
) -> None:
    """Prefix completion per checkpoint, in any order and in order, one panel per task."""
    from lerobot_memobench.evaluation.figures.rollouts import draw_prefix, panels, paper_panel

    runs, paper = given_runs(folders, with_)
    drawn = panels(runs, None if tasks is None else _chosen(tasks, runs))
    _save(draw_prefix([*drawn, *([paper_panel()] if paper else [])]), out, "prefix", runs, paper=False)


@app.command()
def replan(
    folders: Folders = None,
    with_: With = None,
    by: Annotated[
        Grouping | None, typer.Option(help="types: rows of panels for the memory types, under the average.")
    ] = None,
    out: Out = DEFAULT_OUT,
) -> None:
    """SR, MSR, MUR and MCR by replan interval."""
    from lerobot_memobench.evaluation.figures.rates import draw_replan

    runs, paper = given_runs(folders, with_)
    if by is Grouping.TASKS:
        raise MemobenchError("found --by tasks; expected types: replan curves are drawn of averages and memory types")
    _save(draw_replan(runs, paper, by is Grouping.TYPES), out, "replan", runs, paper)


def _chosen(spec: str, runs: list[Run]) -> list[str]:
    """Return task names; those of the evaluations, which may be a user's own, go before the catalogue's words."""
    from lerobot_memobench.tasks.catalogue import resolve_tasks

    there = {name: memory_type for run in runs for name, memory_type in run.summary.memory_type_of.items()}
    if spec in there:
        return [spec]
    chosen = resolve_tasks(spec, runs[0].protocol.get("suite", PUBLISHED) if runs else PUBLISHED)
    return [name for name in chosen if name in there] or chosen


def _save(figure: Figure, out: Path, name: str, runs: list[Run], paper: bool) -> None:
    """Write a figure, and say where it is and what its caption has to tell; ``paper``: of the paper's rows as well."""
    from lerobot_memobench.evaluation.figures.style import caption, paper_style, save

    with paper_style():
        for path in save(figure, out, name):
            say(path)
    say(caption(runs, paper))
