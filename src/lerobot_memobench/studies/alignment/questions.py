"""What a memory is asked: which of the study's subgoals is active at a frame?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import MemoryCache
from lerobot_memobench.studies.alignment.split import Split


@dataclass(frozen=True)
class Asked:
    """Frames with their right answers, for one split.

    Attributes:
        indices: (N,) frames of the dataset.
        labels: (N,) candidate that is right.
        episodes: (N,). tasks: (N,).
        allowed: (N, C) candidates of the frame's own task.
    """

    indices: np.ndarray
    labels: Tensor
    episodes: Tensor
    tasks: np.ndarray
    allowed: Tensor


@dataclass(frozen=True)
class Questions:
    """All frames that are asked about, and the candidates among which an answer is chosen.

    Attributes:
        candidates: (C, d_t) embeddings of the subgoals that are right anywhere. texts: the C subgoals.
        fit, test: of training and of held-out episodes.
    """

    candidates: Tensor
    texts: list[str]
    fit: Asked
    test: Asked


def make_questions(cache: MemoryCache, level: str, split: Split, tasks: np.ndarray) -> Questions:
    """Ask for the subgoal of ``level`` at the split's frames; ``tasks`` (N,) is the task of each frame."""
    rows = cache.text_rows(level)
    used, numbers = np.unique(rows[np.concatenate([split.fit, split.test])], return_inverse=True)
    fit, test = np.split(numbers, [len(split.fit)])
    by_task = np.zeros((int(tasks.max()) + 1, len(used)), dtype=bool)
    for frames, labels in ((split.fit, fit), (split.test, test)):
        by_task[tasks[frames], labels] = True

    def asked(frames: np.ndarray, labels: np.ndarray) -> Asked:
        """Ask about these frames."""
        return Asked(
            indices=frames,
            labels=torch.from_numpy(labels),
            episodes=torch.from_numpy(split.episode[frames]),
            tasks=tasks[frames],
            allowed=torch.from_numpy(by_task[tasks[frames]]),
        )

    return Questions(
        candidates=cache.text_embeddings[torch.from_numpy(used.astype(np.int64))],
        texts=[cache.texts[row] for row in used],
        fit=asked(split.fit, fit),
        test=asked(split.test, test),
    )
