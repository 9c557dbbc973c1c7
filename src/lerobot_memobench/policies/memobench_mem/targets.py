"""Texts that memory is aligned with: the subgoals of a dataset, or those of a control (``align_targets``).

A subgoal of a task with variants names a place in the episode and the hidden answer, such as the drawer to open.
``progress`` keeps the first and ``answers`` the second.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence

import numpy as np

logger = logging.getLogger(__name__)

SHUFFLE_SEED = 7
SHUFFLED_ALONE = 3
"""Smallest number of subgoals of an episode that are permuted among themselves."""
NO_WORD = "-"
"""Text of a subgoal that shares no word with those of other variants."""


def _in_order(texts: Sequence[str]) -> list[str]:
    """Return the distinct subgoals of an episode in the order of their first frames."""
    return [text for text in dict.fromkeys(texts) if text]


def answers(texts: Sequence[str], episodes: np.ndarray) -> list[str]:
    """Return for each frame all subgoals of its episode as one text, which is constant in the episode.

    Args:
        texts: (N,) subgoal of each frame. episodes: (E + 1,) first frame of each episode.
    """
    made: list[str] = []
    for start, end in itertools.pairwise(episodes.tolist()):
        made += ["; ".join(_in_order(texts[start:end]))] * (end - start)
    return made


def progress(texts: Sequence[str], episodes: np.ndarray, tasks: Sequence[str]) -> list[str]:
    """Return each subgoal without the words that differ between the episodes of its task.

    A word is kept if the subgoal at the same place in every episode of the task has it.

    Args:
        texts: (N,) subgoal of each frame. episodes: (E + 1,) first frame of each episode. tasks: (E,).
    """
    bounds = list(itertools.pairwise(episodes.tolist()))
    orders = [_in_order(texts[start:end]) for start, end in bounds]
    shared: dict[tuple[str, int], set[str]] = {}
    for task, order in zip(tasks, orders, strict=True):
        for place, text in enumerate(order):
            words = set(text.split())
            shared[task, place] = shared.get((task, place), words) & words
    made: list[str] = []
    for task, order, (start, end) in zip(tasks, orders, bounds, strict=True):
        cut = {"": ""}
        for place, text in enumerate(order):
            cut[text] = " ".join(word for word in text.split() if word in shared[task, place]) or NO_WORD
        made += [cut[text] for text in texts[start:end]]
    return made


# -- shuffled ----------------------------------------------------------------------------------------------------------


def shuffled(texts: Sequence[str], episodes: np.ndarray) -> list[str]:
    """Return each frame's subgoal after `shuffled_subgoals`.

    Args:
        texts: (N,) subgoal of each frame, at least two different ones. episodes: (E + 1,) first frame of each episode.
    """
    unique = [text for text in sorted({*texts}) if text]
    number = {text: row for row, text in enumerate(unique)}
    rows = np.array([number.get(text, -1) for text in texts])
    moved, elsewhere = shuffled_subgoals(rows, episodes)
    logger.info(
        "subgoals are shuffled: %d of %d episodes permute their own; %d have fewer than %d and take texts of other "
        "episodes",
        len(episodes) - 1 - elsewhere,
        len(episodes) - 1,
        elsewhere,
        SHUFFLED_ALONE,
    )
    return [unique[row] if row >= 0 else "" for row in moved.tolist()]


def shuffled_subgoals(rows: np.ndarray, episodes: np.ndarray, seed: int = SHUFFLE_SEED) -> tuple[np.ndarray, int]:
    """Permute the subgoals within each episode: a control of the paper.

    Two subgoals of a task would be exchanged in every episode alike, which renames the texts and keeps their
    information. Episodes with fewer than `SHUFFLED_ALONE` subgoals therefore draw texts of other episodes: of other
    tasks if there are enough, else of the whole dataset.

    Args:
        rows: (N,) text index per frame, -1 for none. episodes: (E + 1,) first frame of each episode.
        seed: of the permutation.

    Returns:
        (N,) text indices, and the number of episodes that drew texts of others.
    """
    shuffled, every, elsewhere = rows.copy(), np.unique(rows[rows >= 0]), 0
    for episode, (start, end) in enumerate(itertools.pairwise(episodes)):
        present = np.unique(rows[start:end])
        present = present[present >= 0]
        chance = np.random.default_rng([seed, episode])
        if len(present) >= SHUFFLED_ALONE:
            # A rotation of a random order moves every subgoal.
            order = chance.permutation(present)
            replaced, by = order, np.roll(order, 1)
        else:
            others = np.setdiff1d(every, present)
            pool = others if len(others) >= SHUFFLED_ALONE * len(present) else every
            replaced, by = present, chance.choice(pool, len(present), replace=False)
            elsewhere += 1
        replace = dict(zip(replaced.tolist(), by.tolist(), strict=True))
        shuffled[start:end] = [replace.get(row, -1) for row in rows[start:end].tolist()]
    return shuffled, elsewhere
