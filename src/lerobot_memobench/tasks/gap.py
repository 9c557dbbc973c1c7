"""Read the gap of checkpoints: control steps from the cue to its use, measured on the scripted expert.

``docs/benchmark/gap.md`` defines the gap; ``scripts/gaps.py`` writes ``gaps.json``.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import NamedTuple

from lerobot_memobench.tasks.task import STRICT, Task

GAPS_FILE = Path(__file__).with_name("gaps.json")


class Gap(NamedTuple):
    """Control steps over the expert's episodes, without holds; ``held``: the first hold lies between cue and use."""

    least: int
    median: int
    most: int
    held: bool

    def __str__(self) -> str:
        return f"{self.median} + hold" if self.held else str(self.median)


def cue_in_prompt(task: Task, checkpoint: int) -> bool:
    """Return whether the demonstration prompt shows the answer to a checkpoint (0 is the first).

    After a hiding, only the first choice, the drawer, depends on the prompt.
    """
    return task.prompt is not None and (task.prompt.kind != "hide" or checkpoint == 0)


def gaps(task: Task) -> tuple[Gap | None, ...]:
    """Return the gap of each checkpoint, () for a task that was not measured; None: nothing has to be remembered."""
    rows = _measured().get(task.name, [])
    return tuple(
        None if row is None else Gap(row[0], row[1], row[2], held=task.suite == STRICT and cue_in_prompt(task, k))
        for k, row in enumerate(rows)
    )


def longest_gap(task: Task) -> Gap | None:
    """Return the largest median gap of a task's checkpoints; None for a task without one or not measured."""
    return max((gap for gap in gaps(task) if gap is not None), key=lambda gap: (gap.held, gap.median), default=None)


@cache
def _measured() -> dict[str, list[list[int] | None]]:
    rows: dict[str, list[list[int] | None]] = json.loads(GAPS_FILE.read_text())
    return rows
