"""Texts of checkpoints for a privileged memory: all texts of a dataset, and those of each task.

A task is identified by its instruction. The texts come from the training dataset and are kept in the policy's
configuration (``subgoals``); the environment never reveals which of them is active.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.tasks.memory_text import MARK

logger = logging.getLogger(__name__)


def texts_of(subgoals: Mapping[str, Sequence[str]]) -> tuple[str, ...]:
    """Return all texts, sorted; a memory refers to them by their indices."""
    return tuple(sorted({text for own in subgoals.values() for text in own}))


def subgoals_of(texts: Sequence[str], episodes: np.ndarray, tasks: Iterable[Iterable[str]]) -> dict[str, list[str]]:
    """Return instruction -> sorted texts of its checkpoints.

    Args:
        texts: (N,) subgoal of each frame, "" for none. episodes: (E + 1,) first frame of each episode.
        tasks: (E,) instructions of each episode.
    """
    found = dict[str, set[str]]()
    for instructions, (start, end) in zip(tasks, itertools.pairwise(episodes.tolist()), strict=True):
        for task in instructions:
            found.setdefault(str(task), set()).update(text for text in texts[start:end] if text)
    return {task: sorted(own) for task, own in sorted(found.items())}


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
