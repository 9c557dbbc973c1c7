"""Texts of checkpoints by which a privileged memory learns and chooses: which there are, and which a task has.

A task is known by its instruction. Its texts come from the training's dataset and stand in the policy's configuration
(``subgoals``); the environment never tells which of them is the active one.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.datasets.frames import LEVEL_COLUMNS, read_frame_table
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.memory_text import MARK

logger = logging.getLogger(__name__)


def texts_of(subgoals: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return all texts, whose places here are the numbers by which a memory knows them."""
    return tuple(sorted({text for own in subgoals.values() for text in own}))


def subgoals_of(meta: Any, level: str) -> dict[str, list[str]]:
    """Return instruction -> texts of its checkpoints at a level, each once and sorted, of a dataset.

    Args:
        meta: the dataset's metadata, as LeRobot has it.

    Raises:
        MemobenchError: it has no texts at this level.
    """
    table, found = read_frame_table(Path(meta.root)), dict[str, set[str]]()
    texts = table.subgoals.get(level, [])
    for tasks, (start, end) in zip(meta.episodes["tasks"], itertools.pairwise(table.episodes.tolist()), strict=True):
        for task in tasks:
            found.setdefault(str(task), set()).update(text for text in texts[start:end] if text)
    if not any(found.values()):
        raise MemobenchError(
            f"The dataset {meta.root} has no {level} subgoals (no text in a column '{LEVEL_COLUMNS[level]}'), by which "
            "this memory learns what to say; name a dataset of `memobench generate`, another policy.subgoal_level, or "
            "another policy.memory."
        )
    return {task: sorted(own) for task, own in sorted(found.items())}


def require_known(subgoals: dict[str, list[str]], meta: Any, level: str) -> None:
    """Refuse to train a memory on texts that the checkpoint it begins with does not know.

    Raises:
        MemobenchError: the dataset has such texts.
    """
    known = texts_of(subgoals)
    new = [text for text in texts_of(subgoals_of(meta, level)) if text not in known]
    if new:
        raise MemobenchError(
            f"The dataset {meta.root} has {len(new)} checkpoint texts that this memory cannot say, the first being "
            f"{new[0]!r}; train on the tasks it was trained on, or begin its memory anew by "
            "--policy.subgoals=null."
        )


_told: set[str] = set()
"""Instructions about which this process has been warned."""


def choices(subgoals: dict[str, list[str]], tasks: str | Sequence[str]) -> Tensor:
    """Return which of all texts each row's task has, (B, S) bool; all, where an instruction is unknown.

    Args:
        subgoals: instruction -> texts of its checkpoints. tasks: the rows' instructions, oracle memory text behind them
            perhaps.
    """
    texts, rows = texts_of(subgoals), dict[str, list[bool]]()
    tasks = [task.partition(MARK)[0] for task in ([tasks] if isinstance(tasks, str) else tasks)]
    for task in dict.fromkeys(tasks):
        own = subgoals.get(task)
        if own is None and task not in _told:
            _told.add(task)
            logger.warning("the memory knows no checkpoints of %r, and chooses among those of all tasks", task)
        rows[task] = [own is None or text in own for text in texts]
    return torch.tensor([rows[task] for task in tasks])
