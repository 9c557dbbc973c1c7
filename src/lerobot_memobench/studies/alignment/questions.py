"""What a memory is asked: which of the study's subgoals is active at a frame?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.protocol import PROMPT
from lerobot_memobench.studies.alignment.split import Split


@dataclass(frozen=True)
class Asked:
    """Frames with their right answers, for one split.

    Attributes:
        indices: (N,) frames of the dataset.
        labels: (N,) candidate that is right.
        episodes: (N,). tasks: (N,) numbers, as the split has them.
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


def make_questions(frames: FrameLookup, level: str, split: Split, per_episode: int) -> Questions:
    """Ask for the subgoal of ``level`` at execution frames, at most ``per_episode`` of each episode."""
    rows, episodes = frames.text_rows(level), frames.episodes
    askable = (frames.phase != PROMPT) & (rows >= 0)
    parts = [split.frames(askable, episodes, per_episode, held=held) for held in (False, True)]
    used, numbers = np.unique(rows[np.concatenate(parts)], return_inverse=True)
    episode_of = np.repeat(np.arange(len(split.task)), np.diff(episodes))
    task_of = split.task[episode_of]
    by_task = np.zeros((len(split.tasks), len(used)), dtype=bool)
    by_task[task_of[np.concatenate(parts)], numbers] = True
    fit, test = (
        Asked(
            indices=indices,
            labels=torch.from_numpy(labels),
            episodes=torch.from_numpy(episode_of[indices]),
            tasks=task_of[indices],
            allowed=torch.from_numpy(by_task[task_of[indices]]),
        )
        for indices, labels in zip(parts, np.split(numbers, [len(parts[0])]), strict=True)
    )
    return Questions(
        candidates=frames.text_embeddings[torch.from_numpy(used.astype(np.int64))],
        texts=[frames.texts[row] for row in used],
        fit=fit,
        test=test,
    )


def guesses(questions: Questions) -> dict[str, Any]:
    """Return what is right without looking: at random, and by the commonest subgoal of the training episodes."""
    test, count = questions.test, len(questions.candidates)
    common = torch.bincount(questions.fit.labels, minlength=count)
    in_task = torch.where(test.allowed, common, -1)
    return {
        "chance": {"all": 1.0 / count, "own_task": float((1.0 / test.allowed.sum(dim=1)).mean())},
        "commonest": {
            "all": float((test.labels == common.argmax()).double().mean()),
            "own_task": float((test.labels == in_task.argmax(dim=1)).double().mean()),
        },
    }
