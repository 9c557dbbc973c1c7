"""``memobench tasks``: what the benchmark asks for, as a table or JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from lerobot_memobench.tasks.catalogue import find_tasks, get_task, task_names, task_record
from lerobot_memobench.tasks.task import Task, load_task


def load_tasks(folder: Path | None) -> list[Task]:
    """Return the catalogue's tasks, or those of a task folder or of a folder of task folders.

    Raises:
        MemobenchError: no task is there, or one cannot be loaded.
    """
    if folder is None:
        return [get_task(name) for name in task_names()]
    return [load_task(place) for place in find_tasks(folder)]


def records(found: list[Task]) -> list[dict[str, Any]]:
    """Return what ``memobench tasks --json`` prints; state sizes come from the compiled models."""
    from lerobot_memobench.sim.simulation import Simulation

    return [task_record(task, Simulation(task).state_dim) for task in found]


def task_table(found: list[Task]) -> Table:
    """Return one row per task."""
    table = Table(title=f"{len(found)} tasks", title_justify="left", header_style="bold", pad_edge=False)
    for name in ("memory type", "task", "checkpoints", "prompt video", "instruction"):
        table.add_column(name, overflow="fold")
    for k, task in enumerate(found):
        if k and task.memory_type != found[k - 1].memory_type:
            table.add_section()
        prompt = task.prompt.kind if task.prompt else ""
        table.add_row(task.memory_type, task.name, task.operations, prompt, task.language)
    return table
