"""``python -m research.necessity``: which tasks need a memory."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import Count, SuiteOption, console, counting
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks
from research.command import run

if TYPE_CHECKING:
    from lerobot_memobench.jobs.processes import Advance, ProgressCallback
    from lerobot_memobench.tasks.task import Task
    from research.necessity.settings import Settings
    from research.necessity.study import Study


class WhichReferent(StrEnum):
    """Which settings of the referent are looked at."""

    FIXED = "fixed"
    RANDOM = "random"
    BOTH = "both"


def necessity(
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    suite: SuiteOption = "published",
    referent: Annotated[
        WhichReferent, typer.Option(help="Goal of object and procedural tasks: fixed, random, or both settings.")
    ] = WhichReferent.BOTH,
    episodes: Annotated[int, typer.Option(min=1, help="Scenes per task, from seed 7 on.")] = 3,
    budget: Annotated[
        int, typer.Option(min=0, help="Steps simulated per start in search of other ways to the goal; 0: no search.")
    ] = 10_000,
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of differing pixels up to which pictures look the same.")
    ] = 0.005,
    out: Annotated[Path, typer.Option(help="Folder of the results; the same command goes on there.")] = Path(
        "outputs/necessity"
    ),
    workers: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    memoryless: Annotated[
        list[Path] | None,
        typer.Option(help="Evaluation of a trained policy without a memory, added to the table; repeatable."),
    ] = None,
) -> None:
    """Find frames that look alike and need different answers: lower bounds of a policy without a memory."""
    from lerobot_memobench.tasks.task import REFERENTS
    from research.necessity.report import terminal_table, write
    from research.necessity.settings import Settings
    from research.necessity.study import PIECES, make
    from research.necessity.trained import read_evaluations, with_evaluations

    evaluated = read_evaluations(memoryless or [])
    settings = Settings(episodes=episodes, budget=budget, tolerance=tolerance)
    referents = REFERENTS if referent is WhichReferent.BOTH else (referent.value,)
    studies = _studies([get_task(name) for name in resolve_tasks(tasks, suite)], referents, settings, out)
    screen = console()
    for piece, unit in PIECES.items():
        with counting(screen, unit) as count:
            make(studies, piece, workers, _progress(count))
    results = with_evaluations([study.result() for study in studies], evaluated)
    written = write(out, results)
    screen.print(terminal_table(results), crop=False)
    for path in written:
        screen.print(str(path), soft_wrap=True)


def _progress(count: Count) -> ProgressCallback:
    def show(news: Advance) -> None:
        count(news.done, news.total, f"{news.task_name}, seed {news.seed}", found=news.found)

    return show


def _studies(tasks: Sequence[Task], referents: Sequence[str], settings: Settings, out: Path) -> list[Study]:
    """Return every task with every setting of the referent in which it differs."""
    from research.necessity.settings import settings_of
    from research.necessity.study import Study

    return [Study(task, setting, settings, out) for task in tasks for setting in settings_of(task, referents)]


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("necessity", necessity, argv)


if __name__ == "__main__":
    sys.exit(main())
