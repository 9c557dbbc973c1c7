"""``memobench generate`` and ``memobench cache``: the data a policy is taught with."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.table import Table

from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.tasks.catalogue import get_task, resolve_tasks

if TYPE_CHECKING:
    from lerobot_memobench.datasets.generation_summary import GenerationSummary
    from lerobot_memobench.jobs.job import Advance


def generate(tasks: str, episodes: int, out: Path, **settings: Any) -> int:
    """Make the demonstrations and print what became of them; return the exit status (1: a seed failed)."""
    chosen = [get_task(name) for name in resolve_tasks(tasks)]
    from lerobot_memobench.datasets.generation import generate as run

    screen = console()
    with counting(screen, "episodes", len(chosen) * episodes) as count:

        def advance(news: Advance) -> None:
            what = f"{news.task_name}, seed {news.seed}"
            count(news.done, news.total, what, trouble=news.failure, found=news.found)

        summary = run(chosen, episodes, out, progress=advance, **settings)
    screen.print(_summary_table(summary))
    for failure in summary.failures:
        screen.print(f"no demonstration of {failure.task_name}, seed {failure.seed}: {failure.reason}")
    if summary.submitted:
        screen.print(f"jobs are submitted; the last of them assembles the dataset in {out}", soft_wrap=True)
    elif summary.folder is None:
        screen.print("no dataset was written: no seed was solved")
    else:
        screen.print(f"dataset: {summary.folder}", soft_wrap=True)
    return summary.exit_status


def _summary_table(summary: GenerationSummary) -> Table:
    table = Table(header_style="bold", pad_edge=False)
    table.add_column("task", overflow="fold")
    for name in ("solved", "of", "frames", "mean length"):
        table.add_column(name, justify="right")
    for task in summary.tasks:
        mean = f"{sum(task.frames) / len(task.frames):.0f}" if task.frames else "–"
        table.add_row(task.name, str(task.solved), str(task.episodes), str(sum(task.frames)), mean)
    return table


def cache(
    dataset: Path,
    *,
    size: str,
    stride: int,
    weights: str | None,
    device: str | None,
    batch_size: int,
    workers: int | None = None,
) -> None:
    """Make the memory cache of a dataset and print where it is."""
    from lerobot_memobench.cli.preflight import quiet
    from lerobot_memobench.policies.memobench_mem.caching import cache_dataset
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

    with quiet():
        config = MemobenchMemConfig(size=size, memory_stride=stride, device=device)
    screen = console()
    with counting(screen, "episodes") as count:
        folder = cache_dataset(dataset, config, weights=weights, batch_size=batch_size, workers=workers, progress=count)
    screen.print(f"memory cache: {folder}", soft_wrap=True)
