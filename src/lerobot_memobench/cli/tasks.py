"""``memobench tasks``, ``objects`` and ``recipe``: lists of what the package holds."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from lerobot_memobench.cli.console import Suite, WhichSuite, console, say
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.tables import Unbroken
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.catalogue import (
    CATALOGUE_DIR,
    find_tasks,
    get_task,
    load_task,
    task_names,
    task_number,
    task_record,
)
from lerobot_memobench.tasks.task import PUBLISHED, Task


def tasks(
    as_json: Annotated[bool, typer.Option("--json", help="Print everything about each task as JSON.")] = False,
    suite: WhichSuite = Suite.PUBLISHED,
    folder: Annotated[
        Path | None,
        typer.Option("--dir", help="A task folder, or a folder of them, instead of the catalogue."),
    ] = None,
) -> int:
    """List the benchmark's tasks, or those of a folder."""
    found, problems = load_tasks(folder, suite)
    if as_json:
        from lerobot_memobench.sim.simulation import Simulation

        # State sizes come from the compiled models.
        print(json.dumps([task_record(task, Simulation(task).state_dim) for task in found], indent=1))
    else:
        console().print(Unbroken(task_table(found), column=1), crop=False)
    for problem in problems:
        print(f"memobench: {problem}", file=sys.stderr)
    return 1 if problems else 0


def load_tasks(folder: Path | None, suite: str = PUBLISHED) -> tuple[list[Task], list[str]]:
    """Return the tasks of a suite, or those below a folder and what keeps others of them from loading.

    Raises:
        MemobenchError: no task is there, or none can be loaded.
    """
    if folder is None:
        return [get_task(name) for name in task_names(suite=suite)], []
    found, problems = [], []
    for place in find_tasks(folder):
        try:
            found.append(load_task(place))
        except MemobenchError as error:
            problems.append(str(error))
    if not found:
        raise MemobenchError(problems[0])
    return found, problems


def task_table(found: Sequence[Task]) -> Table:
    """Return one row per task; the numbers are what ``tasks=`` and ``--tasks`` take, a user's own tasks have none."""
    suites = {task.suite for task in found}
    title = count_of(len(found), "task") + (f" of the {suites.pop()} suite" if len(suites) == 1 else "")
    table = Table(title=title, title_justify="left", header_style="bold", pad_edge=False)
    for name in ("no.", "task", "memory type", "checkpoints", "demonstration prompt", "instruction"):
        table.add_column(name, justify="right" if name == "no." else "left")
    for k, task in enumerate(found):
        if k and task.memory_type != found[k - 1].memory_type:
            table.add_section()
        prompt = task.prompt.kind if task.prompt else ""
        number = str(task_number(task.name)) if CATALOGUE_DIR in task.folder.parents else ""
        table.add_row(number, task.name, task.memory_type, task.operations, prompt, task.title)
    return table


def objects(
    as_json: Annotated[bool, typer.Option("--json", help="Print slots, fields and classes as JSON.")] = False,
) -> None:
    """Print the layout of object observations. Slots, the fields of each, the classes by index."""
    from lerobot_memobench.sim.object_layout import SLOTS
    from lerobot_memobench.sim.object_slots import layout

    found = layout()
    if as_json:
        print(json.dumps(found, indent=1))
        return
    say(f"{SLOTS} slots, one after another; of each:")
    for field in found["fields"]:
        say(f"  {field['start']:>2}  {field['name']} ({field['size']})")
    say("classes: " + ", ".join(f"{k} {name}" for k, name in enumerate(found["classes"])))


def recipe(
    name: Annotated[str | None, typer.Argument(help="A recipe; all are listed without it.")] = None,
) -> int:
    """Print the file of a training recipe. As in `lerobot-train --config_path=$(memobench recipe train_paper)`."""
    from lerobot_memobench.run.arguments import recipe_file, recipes

    if name is not None:
        print(recipe_file(name))
        return 0
    table = Table(header_style="bold", pad_edge=False)
    table.add_column("recipe", no_wrap=True)
    table.add_column("what it trains")
    for key, path in recipes().items():
        table.add_row(key, path.read_text().splitlines()[0].removeprefix("# "))
    console().print(table)
    return 0
