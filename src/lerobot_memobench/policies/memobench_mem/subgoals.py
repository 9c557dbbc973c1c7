"""Texts of checkpoints for a privileged memory: all texts of a dataset, and those of each task.

A task is identified by its instruction. The texts come from the training dataset and are kept in the policy's
configuration (``subgoals``); the environment never reveals which of them is active.
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
    """Return all texts, sorted; a memory refers to them by their indices."""
    return tuple(sorted({text for own in subgoals.values() for text in own}))


def subgoals_of(meta: Any, level: str) -> dict[str, list[str]]:
    """Return instruction -> sorted texts of its checkpoints at a level, of a dataset.

    Args:
        meta: LeRobot's metadata of the dataset.

    Raises:
        MemobenchError: the dataset has no texts at this level.
    """
    table, found = read_frame_table(Path(meta.root)), dict[str, set[str]]()
    texts = table.subgoals.get(level, [])
    for tasks, (start, end) in zip(meta.episodes["tasks"], itertools.pairwise(table.episodes.tolist()), strict=True):
        for task in tasks:
            found.setdefault(str(task), set()).update(text for text in texts[start:end] if text)
    if not any(found.values()):
        raise MemobenchError(
            f"The dataset {meta.root} has no {level} subgoals (no text in a column '{LEVEL_COLUMNS[level]}'), from "
            "which this memory learns; name a dataset of `memobench generate`, another policy.subgoal_level, or "
            "another policy.memory."
        )
    return {task: sorted(own) for task, own in sorted(found.items())}


def require_known(subgoals: dict[str, list[str]], meta: Any, level: str) -> None:
    """Check that a memory knows all texts of a dataset.

    Raises:
        MemobenchError: it was trained without some of them.
    """
    known = texts_of(subgoals)
    new = [text for text in texts_of(subgoals_of(meta, level)) if text not in known]
    if new:
        raise MemobenchError(
            f"The dataset {meta.root} has {len(new)} checkpoint texts that this memory does not know, the first "
            f"being {new[0]!r}; train on the tasks it was trained on, or train a new memory with "
            "--policy.subgoals=null."
        )


_warned: set[str] = set()
"""Instructions about which this process has logged a warning."""


def choices(subgoals: dict[str, list[str]], tasks: str | Sequence[str]) -> Tensor:
    """Return which of all texts belong to each row's task, (B, S) bool; all texts if an instruction is unknown.

    Args:
        subgoals: instruction -> texts of its checkpoints. tasks: the rows' instructions, with or without oracle memory
            text.
    """
    texts, rows = texts_of(subgoals), dict[str, list[bool]]()
    tasks = [task.partition(MARK)[0] for task in ([tasks] if isinstance(tasks, str) else tasks)]
    for task in dict.fromkeys(tasks):
        own = subgoals.get(task)
        if own is None and task not in _warned:
            _warned.add(task)
            logger.warning("the memory knows no checkpoints of %r; it chooses from those of all tasks", task)
        rows[task] = [own is None or text in own for text in texts]
    return torch.tensor([rows[task] for task in tasks])
