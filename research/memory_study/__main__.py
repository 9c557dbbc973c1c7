"""``python -m research.memory_study``: the grid of the memory study, planned, run, resumed and told."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import timedelta
from pathlib import Path
from statistics import mean
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console, counting, say
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html.write import write_html
from lerobot_memobench.io import count_of, write_file
from lerobot_memobench.jobs.processes import Advance, Job
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.jobs.slurm import Needs, Slurm, read_options
from research.command import run
from research.memory_study.cells import CELLS, Cell, Demonstrations, choose_rates, tuning
from research.memory_study.figure import draw_all
from research.memory_study.grid import Grid, chosen, read_grid
from research.memory_study.tables import named_rollouts, tables
from research.pages import put_into

GRID = Path(__file__).with_name("grid.yaml")
STUDY = "memory_study"
NEEDS = Needs(cores=2, memory_gb=8)
"""What a cell of a small policy takes, on Slurm."""


def study(
    out: Annotated[Path, typer.Option(help="Folder of everything; the same command goes on.")],
    grid: Annotated[Path, typer.Option(help="The study's file.")] = GRID,
    only: Annotated[
        list[str] | None, typer.Option(help="A suite, a row or seed=N; repeatable. The others are left as they are.")
    ] = None,
    plan: Annotated[
        bool, typer.Option("--plan", help="Say what would be run, and about how long; run nothing.")
    ] = False,
    keep: Annotated[
        Path | None,
        typer.Option(help="Keep logs, cards and costs of what is evaluated there, compressed; run nothing."),
    ] = None,
    page: Annotated[
        Path | None, typer.Option(help="Markdown page whose tables are made anew, between its marks; run nothing.")
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder of the figures; --out when left out.")] = None,
    sealed: Annotated[
        bool, typer.Option("--sealed", help="Run the sealed test of the cells too: once, when all is chosen.")
    ] = False,
    tune: Annotated[bool, typer.Option("--tune", help="Choose learning rates first, by short trainings.")] = False,
    browse: Annotated[bool, typer.Option("--html", help="Make reports for the browser, one per suite.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Cells at a time.")] = 1,
    slurm: Annotated[str | None, typer.Option(help="Run on Slurm, with these options of sbatch.")] = None,
) -> None:
    """Train and evaluate every cell that is not done, then print and keep the tables and figures."""
    read = read_grid(grid)
    places = chosen(read, only or [])
    if not places:
        raise MemobenchError(f"--only {' '.join(only or [])} leaves no cell; a row has fewer training seeds, perhaps")
    data = [Demonstrations(read, suite, out, workers) for suite in dict.fromkeys(suite for suite, _, _ in places)]
    cells = [Cell(read, out, *place, sealed=sealed, beside=workers) for place in places]
    if keep is not None:
        if keep.resolve() == out.resolve():
            raise MemobenchError(f"--keep {keep} is --out too; name another folder, which gets what is small")
        if keep.exists() and not (keep / CELLS).is_dir() and (not keep.is_dir() or any(keep.iterdir())):
            raise MemobenchError(f"--keep {keep} is no folder of a study; name one that is, or a new one")
        kept = [folder for cell in cells for folder in cell.keep(keep)]
        if not kept:
            raise MemobenchError(f"--out {out} holds no evaluated cell of those asked for, so nothing is kept")
        for of_suite in data:
            of_suite.keep(keep)
        say(f"kept in {keep}: {count_of(len(kept), 'log')}")
    if page is not None:
        text = tables_of(read, out)
        if not text:
            raise MemobenchError(f"--out {out} holds no evaluated cell of this study, so {page} is left as it is")
        put_into(page, STUDY, text)
        draw_all(read, out, figures or out)
        say(f"the tables of {page} are made")
    if keep or page:
        return
    for cell in {(cell.suite, cell.row): cell for cell in reversed(cells)}.values():
        cell.check()
    tried = tuning(read, out, places, workers) if tune else []
    if plan:
        say(planned(data, tried, cells, workers))
        return
    cluster = None if slurm is None else Slurm(read_options(slurm), NEEDS, out / "logs", jobs_per_member=1)
    for what, jobs, at_once in (("demonstrations", data, 1), ("tuning", tried, workers), ("cells", cells, workers)):
        with counting(console(), what, len(jobs)) as count:

            def advance(news: Advance, count=count) -> None:  # type: ignore[no-untyped-def]
                count(news.done, news.total, f"{news.task_name}, seed {news.seed}", found=news.found)

            done = run_jobs(jobs, workers=at_once, progress=advance, slurm=cluster)
        if not done:
            say(f"{what} are submitted; give the command again when they are through")
            return
        if what == "tuning" and tried:
            rates = choose_rates(tried)
            say("; ".join(f"{suite}, {row}: learning rate {rate:g}" for (suite, row), rate in rates.items()))
    text = tables_of(read, out)
    draw_all(read, out, figures or out)
    write_file(out / "study.md", text + "\n")
    if browse:
        for suite in read.suites:
            if folders := [f"{name}={folder}" for name, folder in named_rollouts(read, out, suite)]:
                say(f"open {write_html(folders, out / 'report' / suite).page}")
    say(text)


def tables_of(grid: Grid, out: Path) -> str:
    """Return the tables of what is evaluated in a study's folder."""
    return "\n\n".join(filter(None, (tables(grid, out, suite) for suite in grid.suites)))


def planned(data: Sequence[Demonstrations], tried: Sequence[Cell], cells: Sequence[Cell], workers: int) -> str:
    """Return what is left to do, a line each, and about how long it takes by what has been done."""
    jobs: list[Job] = [*data, *tried, *cells]
    left = [job for job in jobs if not job.finished()]
    lines = [f"{job.task_name}, seed {job.seed}" for job in left]
    took = [sum(cost.wall_s for cost in cell.costs().values()) for cell in cells if cell.finished()]
    ahead = sum(isinstance(job, Cell) and job.tuned is None for job in left)
    told = f", about {timedelta(seconds=round(mean(took) * ahead / workers))} of cells" if took and ahead else ""
    return "\n".join([*lines, f"{len(left)} of {len(jobs)} are left{told}"])


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run(STUDY, study, argv)


if __name__ == "__main__":
    sys.exit(main())
