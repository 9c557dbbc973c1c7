"""``python -m research.memory_study``: run and resume the memory study; make its tables and figure."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from statistics import mean
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console, counting, say
from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.io import write_file
from lerobot_memobench.jobs.processes import Advance, Job, run_jobs
from research.command import run
from research.kept import keep as keep_evaluations
from research.kept import restore
from research.memory_study.cells import Cell, Demonstrations
from research.memory_study.figure import draw
from research.memory_study.grid import GRID_FILE, Grid, chosen, read_grid
from research.memory_study.tables import tables


def study(
    out: Annotated[Path, typer.Option(help="Folder of all results; the same command resumes.")],
    grid: Annotated[Path, typer.Option(help="The study's file.")] = GRID_FILE,
    only: Annotated[list[str] | None, typer.Option(help="A suite, a row or seed=N; repeatable.")] = None,
    plan: Annotated[bool, typer.Option("--plan", help="Print missing cells and an estimate of the time.")] = False,
    keep: Annotated[
        Path | None, typer.Option(help="Add evaluated cells to the Parquet tables in this folder, then stop.")
    ] = None,
    kept: Annotated[
        Path | None, typer.Option(help="Make tables and figure of the cells kept in this folder, then stop.")
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder of the figure; --out by default.")] = None,
    controls: Annotated[bool, typer.Option(help="Run the controls, after all cells.")] = True,
    sealed: Annotated[bool, typer.Option("--sealed", help="Run the sealed test of its rows too: once, last.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Cells at a time.")] = 1,
) -> None:
    """Train and evaluate every missing cell, then print and write the tables and the figure."""
    read = read_grid(grid)
    places = chosen(read, only or [])
    if not places:
        raise MemobenchError(f"--only {' '.join(only or [])} matches no cell; a row may have fewer training seeds")
    if kept is not None:
        if only or keep or plan:
            raise MemobenchError("--kept makes the tables of all kept cells; leave out --only, --keep and --plan")
        with tempfile.TemporaryDirectory() as restored:
            restore(kept, Path(restored))
            write_results(read, Path(restored), out, figures)
        return
    suites = dict.fromkeys(suite for suite, _, _ in places)
    data = [Demonstrations(read, suite, out, workers) for suite in suites]
    cells = [Cell(read, out, *place, sealed=sealed, at_once=workers) for place in places]
    if keep is not None:
        names = [name for cell in cells for name in cell.kept_names()]
        if not names:
            raise MemobenchError(f"--out {out} holds no evaluated cell of those asked for; evaluate one first")
        names += [f"demonstrations/{each.suite}" for each in data if each.finished()]
        keep_evaluations(out, names, keep)
        say(f"kept in {keep}: {count_of(len(names), 'evaluation')} and trainings")
        return
    for cell in {(cell.suite, cell.row): cell for cell in cells}.values():
        cell.check()
    if sealed and not any(read.rows[cell.row].sealed for cell in cells):
        raise MemobenchError("--sealed: the plan has no sealed test of these rows; choose others by --only or --grid")
    if plan:
        say(planned(data, cells, workers))
        return
    uncontrolled = [replace(cell, controlled=False, sealed=False) for cell in cells]  # all rows before any control
    stages = (("demonstrations", data, 1), ("cells", uncontrolled, workers), ("controls", cells, workers))
    for title, jobs, at_once in stages if controls or sealed else stages[:2]:
        with counting(console(), title, len(jobs)) as count:

            def advance(news: Advance, count=count) -> None:  # type: ignore[no-untyped-def]
                count(news.done, news.total, f"{news.task_name}, seed {news.seed}", found=news.found)

            run_jobs(jobs, workers=at_once, progress=advance)
    write_results(read, out, out, figures)


def write_results(grid: Grid, source: Path, out: Path, figures: Path | None) -> None:
    """Print the tables of the cells in ``source``; write them and the figure."""
    text = "\n\n".join(filter(None, (tables(grid, source, suite) for suite in grid.suites)))
    if not text:
        raise MemobenchError(
            "there is no evaluated cell of the study's file; name another --grid, or evaluate one first"
        )
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "study.md", text + "\n")
    folder = figures or out
    folder.mkdir(parents=True, exist_ok=True)
    draw(grid, source, folder / "study.png")
    say(text)


def planned(data: Sequence[Demonstrations], cells: Sequence[Cell], workers: int) -> str:
    """Return the missing jobs, one per line, and an estimate of their time from finished ones."""
    jobs: list[Job] = [*data, *cells]
    left = [job for job in jobs if not job.finished()]
    took = [sum(cost.wall_s for cost in cell.costs().values()) for cell in cells if cell.finished()]
    missing = sum(isinstance(job, Cell) for job in left)
    estimate = (
        f", about {timedelta(seconds=round(mean(took) * missing / workers))} of cells" if took and missing else ""
    )
    lines = [f"{job.task_name}, seed {job.seed}" for job in left]
    return "\n".join([*lines, f"{len(left)} of {len(jobs)} are left{estimate}"])


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("memory_study", study, argv)


if __name__ == "__main__":
    sys.exit(main())
