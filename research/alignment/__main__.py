"""``python -m research.alignment``: train the small policy with every alignment; measure success and memories."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console
from research.command import run


def alignment(
    dataset: Annotated[Path, typer.Argument(help="Folder of a generated dataset; images are not needed.")],
    out: Annotated[Path, typer.Option(help="Folder of policies, rollouts and tables; the same command goes on there.")],
    steps: Annotated[int, typer.Option(min=1, help="Updates per policy.")] = 3000,
    seeds: Annotated[int, typer.Option(min=1, help="Training seeds.")] = 3,
    held_out: Annotated[int, typer.Option(min=1, help="Episodes per task that are never trained on.")] = 4,
    rollouts: Annotated[int, typer.Option(min=1, help="Rollouts per task and policy.")] = 20,
    level: Annotated[str, typer.Option(help="Subgoal level: coarse, intermediate or fine.")] = "intermediate",
    first_seed: Annotated[int, typer.Option(help="First seed of the rollouts; choose settings by 20000.")] = 7,
    workers: Annotated[int, typer.Option(min=1, help="Processes; so many policies are trained at once.")] = 1,
) -> None:
    """Does alignment help? Train policies of each kind and compare. With no, semantic, contrastive and framewise
    alignment, with oracle text and without a memory; by success, what memories tell of the active subgoal, and action
    loss.
    """
    from research.alignment.study import StudySettings, run_study

    screen = console()

    def say(text: str) -> None:
        screen.print(text, soft_wrap=True)

    settings = StudySettings(
        steps=steps, seeds=seeds, held_out=held_out, rollouts=rollouts, first_seed=first_seed, level=level
    )
    tables, figure = run_study(dataset, out, settings, say, workers)
    say(tables)
    say(f"figure: {figure}")


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("alignment", alignment, argv, learns=True)


if __name__ == "__main__":
    sys.exit(main())
