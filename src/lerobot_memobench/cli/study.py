"""``memobench study``: train the small policy with every alignment and show what its memory then knows."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console


def study(
    dataset: Annotated[Path, typer.Argument(help="Folder of a generated dataset of eight tasks or more.")],
    out: Annotated[Path, typer.Option(help="Folder of runs, table and figure; the same command goes on there.")],
    steps: Annotated[int, typer.Option(min=1, help="Updates per run.")] = 300,
    batch_size: Annotated[int, typer.Option(min=2, help="Samples per update.")] = 16,
    seeds: Annotated[int, typer.Option(min=1, help="Runs per alignment.")] = 3,
    held_out: Annotated[int, typer.Option(min=1, help="Episodes per task that are never trained on.")] = 2,
    level: Annotated[str, typer.Option(help="Subgoal level: coarse, intermediate or fine.")] = "intermediate",
    size: Annotated[str, typer.Option(help="Size of the policy.")] = "tiny",
) -> int:
    """Train with none, semantic, contrastive and framewise alignment from the same seeds, and compare what a memory
    tells about the active subgoal on held-out episodes: one table and one figure. A killed run is continued.
    """
    from lerobot_memobench.studies.alignment.settings import StudySettings
    from lerobot_memobench.studies.alignment.study import run_study

    screen = console()

    def say(text: str) -> None:
        screen.print(text, markup=False, soft_wrap=True)

    settings = StudySettings(steps=steps, batch_size=batch_size, seeds=seeds, held_out=held_out, level=level, size=size)
    table, figure = run_study(dataset, out, settings, say)
    say(table)
    say(f"figure: {figure}")
    return 0
