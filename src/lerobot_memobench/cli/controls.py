"""``memobench necessity`` and ``memobench controls …``: what tasks ask of a memory, and what controls tell of it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import console, progress_bar
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks

if TYPE_CHECKING:
    from lerobot_memobench.evaluation.necessity_report import Result


app = typer.Typer(
    help="What the paper's controls tell: oracle memory, shuffled memory, annotation granularity.", no_args_is_help=True
)


class WhichReferent(StrEnum):
    """Which settings of the referent are looked at."""

    FIXED = "fixed"
    RANDOM = "random"
    BOTH = "both"


def necessity(
    tasks: Annotated[str, typer.Option(help="all, memory types or task names, separated by commas.")] = "all",
    referent: Annotated[
        WhichReferent, typer.Option(help="Goal of object and procedural tasks: fixed, random, or both settings.")
    ] = WhichReferent.BOTH,
    episodes: Annotated[int, typer.Option(min=1, help="Scenes per task, from seed 7 on.")] = 3,
    budget: Annotated[
        int, typer.Option(min=0, help="Moves simulated per task in search of other ways to the goal; 0: no search.")
    ] = 60,
    tolerance: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of differing pixels up to which pictures look the same.")
    ] = 0.005,
    out: Annotated[Path, typer.Option(help="Folder of the results; the same command goes on there.")] = Path(
        "outputs/necessity"
    ),
) -> int:
    """Find moments that look the same and need different answers; print what a policy without memory can reach."""
    from lerobot_memobench.evaluation.necessity_report import terminal_table, write
    from lerobot_memobench.evaluation.necessity_study import REFERENTS, Settings, study

    settings = Settings(episodes=episodes, budget=budget, tolerance=tolerance)
    settings_of = REFERENTS if referent is WhichReferent.BOTH else (referent.value,)
    chosen = [get_task(name) for name in resolve_tasks(tasks)]
    jobs = [
        (task, setting)
        for task in chosen
        for setting in settings_of
        # With one goal only, both settings are the same.
        if task.num_variants > 1 or setting == settings_of[0]
    ]
    screen = console()
    results: list[Result] = []
    with progress_bar(screen) as progress:
        bar = progress.add_task("tasks", total=len(jobs))
        for task, setting in jobs:
            results.append(study(task, setting if task.num_variants > 1 else REFERENTS[0], settings, out))
            progress.update(bar, advance=1)
            if not screen.is_terminal:
                progress.console.print(f"{len(results)}/{len(jobs)} {task.name}, referent {setting}")
    written = write(out, results)
    screen.print(terminal_table(results))
    for path in written:
        screen.print(str(path), soft_wrap=True)
    return 0
