"""``memobench necessity``: what tasks ask of a memory."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.cli.suite import Suite, WhichSuite
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.necessity.study import Result
    from lerobot_memobench.tasks.task import Task


class WhichReferent(StrEnum):
    """Which settings of the referent are looked at."""

    FIXED = "fixed"
    RANDOM = "random"
    BOTH = "both"


def necessity(
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    suite: WhichSuite = Suite.PUBLISHED,
    referent: Annotated[
        WhichReferent, typer.Option(help="Goal of object and procedural tasks: fixed, random, or both settings.")
    ] = WhichReferent.BOTH,
    episodes: Annotated[int, typer.Option(min=1, help="Scenes per task, from seed 7 on.")] = 3,
    budget: Annotated[
        int, typer.Option(min=0, help="Steps simulated per task in search of other ways to the goal; 0: no search.")
    ] = 10_000,
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of differing pixels up to which pictures look the same.")
    ] = 0.005,
    out: Annotated[Path, typer.Option(help="Folder of the results; the same command goes on there.")] = Path(
        "outputs/necessity"
    ),
    page: Annotated[
        Path | None, typer.Option(help="Markdown page whose table is made anew, between its marks.")
    ] = None,
) -> int:
    """Find moments that look the same and need different answers; print what a policy without memory can reach."""
    from lerobot_memobench.evaluation.necessity.question import REFERENTS, Settings
    from lerobot_memobench.evaluation.necessity.report import put_into_page, terminal_table, write
    from lerobot_memobench.evaluation.necessity.study import study

    settings = Settings(episodes=episodes, budget=budget, tolerance=tolerance)
    referents = REFERENTS if referent is WhichReferent.BOTH else (referent.value,)
    jobs = _jobs([get_task(name) for name in resolve_tasks(tasks, suite)], referents)
    screen = console()
    results: list[Result] = []
    with counting(screen, "tasks", len(jobs)) as count:
        for task, setting in jobs:
            results.append(study(task, setting if task.num_variants > 1 else REFERENTS[0], settings, out))
            count(len(results), len(jobs), f"{task.name}, referent {setting}")
    written = write(out, results)
    if page is not None:
        written.append(put_into_page(page, results))
    screen.print(terminal_table(results))
    for path in written:
        screen.print(str(path), soft_wrap=True)
    return 0


def _jobs(tasks: Sequence[Task], referents: Sequence[str]) -> list[tuple[Task, str]]:
    """Return every task with every setting of the referent; with one goal only, all settings are the same."""
    return [
        (task, setting) for task in tasks for setting in referents if task.num_variants > 1 or setting == referents[0]
    ]
