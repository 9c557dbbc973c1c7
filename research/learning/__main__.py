"""``python -m research.learning``: from no data to memory policies and what they solve."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import Suite, WhichSuite, console
from research.command import run

EXPERIMENTS = "bowl: one task, in minutes; prompted: ten tasks; joint: all thirty."


class Name(StrEnum):
    """The experiments (`experiments`)."""

    BOWL = "bowl"
    PROMPTED = "prompted"
    JOINT = "joint"


class Perception(StrEnum):
    """What policies observe by (`experiments.PERCEPTIONS`)."""

    OBJECTS = "objects"
    DETECTIONS = "detections"
    PIXELS = "pixels"


def learning(
    name: Annotated[Name, typer.Argument(help=EXPERIMENTS)],
    out: Annotated[Path, typer.Option(help="Folder of data, policies, rollouts and tables; the same command goes on.")],
    tasks: Annotated[
        str | None, typer.Option(help="These alone: memory types or task names, separated by commas.")
    ] = None,
    suite: WhichSuite = Suite.PUBLISHED,
    episodes: Annotated[int | None, typer.Option(min=1, help="Demonstrations per task.")] = None,
    prompted_episodes: Annotated[
        int | None, typer.Option(min=1, help="Demonstrations per task with a prompt; --episodes unless told.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Updates per policy.")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds.")] = None,
    rollouts: Annotated[int | None, typer.Option(min=1, help="Rollouts per task and policy.")] = None,
    first_seed: Annotated[
        int | None, typer.Option(help="First seed of the rollouts; choose settings by 20000.")
    ] = None,
    perception: Annotated[
        Perception,
        typer.Option(
            help="objects: privileged object state; detections: in rollouts the detector's, in training privileged "
            "object state with their noise; pixels: tokens of the visual encoder, from demonstrations with pictures."
        ),
    ] = Perception.OBJECTS,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="One more word for `lerobot train` of all policies; repeatable.")
    ] = None,
    dataset: Annotated[Path | None, typer.Option(help="Demonstrations that are there already.")] = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes; so many policies are trained at once.")] = 1,
) -> None:
    """Generate, train with a memory and without, and compare. The policies are rolled out on the evaluation seeds."""
    from lerobot_memobench.tasks.catalogue import resolve_tasks
    from research.learning.experiments import changed, experiment
    from research.learning.study import learn

    screen = console()
    given = {"episodes": episodes, "steps": steps, "seeds": seeds, "rollouts": rollouts, "first_seed": first_seed}
    given["prompted_episodes"] = prompted_episodes or episodes
    alone = None if tasks is None else tuple(resolve_tasks(tasks, suite))
    chosen = experiment(name.value, perception.value, suite)
    chosen = changed(chosen, tasks=alone, **given, settings=(*chosen.settings, *(settings or ())))
    screen.print(learn(chosen, out, lambda text: screen.print(text, soft_wrap=True), dataset=dataset, workers=workers))


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run("learning", learning, argv, learns=True)


if __name__ == "__main__":
    sys.exit(main())
