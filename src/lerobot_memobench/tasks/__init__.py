"""What is the benchmark? Tasks, checkpoints, formulas and the catalogue. No simulator, no torch."""

from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.catalogue import (
    get_task,
    load_task,
    resolve_tasks,
    task_index,
    task_names,
    task_number,
    task_record,
)
from lerobot_memobench.tasks.formula import And, Atom, Formula, Not, Or, Then
from lerobot_memobench.tasks.progress import Evaluator, Progress
from lerobot_memobench.tasks.task import Checkpoint, Prompt, Task, Variant

__all__ = [
    "And",
    "Atom",
    "Checkpoint",
    "Evaluator",
    "Formula",
    "Not",
    "Or",
    "Progress",
    "Prompt",
    "Region",
    "Task",
    "Then",
    "Variant",
    "get_task",
    "load_task",
    "resolve_tasks",
    "task_index",
    "task_names",
    "task_number",
    "task_record",
]
