"""``python -m research.detector train|test``: train and measure a visual encoder and object detector."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.jobs.processes import Advance
from research.command import run

Tasks = Annotated[
    str | None, typer.Option(help="all, memory types or task names of the published suite; both suites by default.")
]
Episodes = Annotated[int, typer.Option(min=1, help="Episodes of each task that frames are taken from.")]
Frames = Annotated[int, typer.Option(min=1, help="Frames of each episode; six images each.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that make images.")]


def train(
    out: Annotated[Path, typer.Option(help="Folder of images, checkpoint and weights; the same command resumes.")],
    tasks: Tasks = None,
    episodes: Episodes = 2,
    frames: Frames = 22,
    first_seed: Annotated[int, typer.Option(help="First seed of the episodes, 30000 to 39999.")] = 30_000,
    updates: Annotated[int, typer.Option(min=1, help="Updates of the weights.")] = 2000,
    batch: Annotated[int, typer.Option(min=1, help="Images of each.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Of first weights, order and augmentation.")] = 0,
    start: Annotated[
        str | None, typer.Option(help="Detector to begin with, a file or package; from random weights by default.")
    ] = None,
    workers: Workers = 1,
) -> None:
    """Make labelled images of the benchmark and train a visual encoder and detector on them."""
    from research.detector.data import TRAINED, DetectorData
    from research.detector.labels import kinds
    from research.detector.training import Training
    from research.detector.training import train as train_detector

    screen = console()
    data = DetectorData(_names(tasks), first_seed, episodes, frames, workers)
    with counting(screen, "episodes") as count, counting(screen, "updates", updates) as learned:
        pictures = data.pictures(out / "pictures", TRAINED, lambda at: _count(count, at))
        settings = Training(updates=updates, batch=batch, seed=seed, start=start)
        file = train_detector(pictures, kinds(), out, settings, progress=learned)
    screen.print(f"detector: {file}", soft_wrap=True)


def measure(
    detector: Annotated[Path, typer.Argument(help="A file of `train`, or package.")],
    out: Annotated[Path, typer.Option(help="Folder of images, table and numbers.")],
    tasks: Tasks = None,
    episodes: Episodes = 1,
    frames: Frames = 8,
    first_seed: Annotated[int, typer.Option(help="First seed of the episodes, 40000 to 59999.")] = 40_000,
    workers: Workers = 1,
) -> None:
    """Measure a detector by kind and camera, in images of seeds that no training uses."""
    from research.detector.data import TESTED, DetectorData
    from research.detector.evaluation import evaluate

    screen = console()
    data = DetectorData(_names(tasks), first_seed, episodes, frames, workers)
    with counting(screen, "episodes") as count:
        table = evaluate(detector, out, lambda: data.pictures(out / "pictures", TESTED, lambda at: _count(count, at)))
    screen.print(table, soft_wrap=True)


def _names(tasks: str | None) -> list[str]:
    from lerobot_memobench.tasks.catalogue import resolve_tasks, task_names

    return task_names(suite=None) if tasks is None else resolve_tasks(tasks)


def _count(count: Callable[..., None], at: Advance) -> None:
    count(at.done, at.total, f"{at.task_name}, seed {at.seed}", found=at.found)


def main(argv: list[str] | None = None) -> int:
    """Run the command; return the exit status."""
    name, *rest = (sys.argv[1:] if argv is None else argv) or ["--help"]
    if name == "--help":
        print(__doc__, "Each has --help.", sep="\n")
        return 0
    commands: dict[str, Callable[..., None]] = {"train": train, "test": measure}
    command = commands.get(name)
    if command is None:
        print("python -m research.detector: name `train` or `test` (each has --help)", file=sys.stderr)
        return 2
    return run(f"detector {name}", command, rest, learns=True)


if __name__ == "__main__":
    sys.exit(main())
