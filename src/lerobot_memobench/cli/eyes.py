"""``memobench eyes …``: a small tower that sees the benchmark's things, trained and tested on this machine."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lerobot_memobench.cli.console import Count, console, counting

if TYPE_CHECKING:
    from lerobot_memobench.jobs.processes import Advance

app = typer.Typer(help="Train eyes, a small tower, on labelled pictures, and test it.", no_args_is_help=True)

Tasks = Annotated[
    str | None, typer.Option(help="all, memory types or task names of the published suite; both suites by default.")
]
Episodes = Annotated[int, typer.Option(min=1, help="Episodes of each task that moments are taken from.")]
Moments = Annotated[int, typer.Option(min=1, help="Moments of each episode; six pictures each.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes that make pictures.")]


@app.command()
def train(
    out: Annotated[Path, typer.Option(help="Folder of pictures, checkpoint and weights; the same command goes on.")],
    tasks: Tasks = None,
    episodes: Episodes = 8,
    moments: Moments = 22,
    first_seed: Annotated[int, typer.Option(help="First seed of the episodes, 20000 to 39999.")] = 20_000,
    updates: Annotated[int, typer.Option(min=1, help="Updates of the weights.")] = 18_000,
    batch: Annotated[int, typer.Option(min=1, help="Pictures of each.")] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Of first weights, order and changes of pictures.")] = 0,
    workers: Workers = 1,
) -> int:
    """Make labelled pictures of the benchmark and train a tower on them: tokens, pooled tokens and heads."""
    from lerobot_memobench.perception.school import Lessons, learn
    from lerobot_memobench.perception.training import Training

    screen = console()
    lessons = Lessons(_names(tasks), first_seed, episodes, moments, workers)
    settings = Training(updates=updates, batch=batch, seed=seed)
    with counting(screen, "episodes") as count, counting(screen, "updates", updates) as learned:
        file = learn(out, lessons, settings, made=_telling(count), progress=learned)
    screen.print(f"eyes: {file}", soft_wrap=True)
    return 0


@app.command("test")
def examine(
    eyes: Annotated[Path, typer.Argument(help="File that `memobench eyes train` has written, or package.")],
    out: Annotated[Path, typer.Option(help="Folder of pictures, table, numbers and a picture of what was found.")],
    tasks: Tasks = None,
    episodes: Episodes = 1,
    moments: Moments = 8,
    first_seed: Annotated[int, typer.Option(help="First seed of the episodes, 40000 to 59999.")] = 40_000,
    workers: Workers = 1,
) -> int:
    """Tell how far off eyes are, by class and camera, in pictures of seeds that nothing is trained on."""
    from lerobot_memobench.perception.school import Lessons
    from lerobot_memobench.perception.school import examine as run

    screen = console()
    with counting(screen, "episodes") as count:
        made = _telling(count)
        table = run(eyes, out, Lessons(_names(tasks), first_seed, episodes, moments, workers), made=made)
    screen.print(table, soft_wrap=True)
    return 0


def _names(tasks: str | None) -> list[str]:
    from lerobot_memobench.tasks.catalogue import resolve_tasks, task_names

    return task_names(suite=None) if tasks is None else resolve_tasks(tasks)


def _telling(count: Count) -> Callable[[Advance], None]:
    return lambda at: count(at.done, at.total, f"{at.task_name}, seed {at.seed}", found=at.found)
