"""The subgoal texts that training samples are aligned with: one per sample, or one per remembered frame."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frames import LEVEL_COLUMNS, MEMORY_COLUMN, holds_texts
from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.batch import TEXT, TEXT_MASK

logger = logging.getLogger(__name__)

SEVERAL = 3
"""Subgoals of an episode that can change places in more than one way."""


def require_texts(root: Path, config: MemobenchMemConfig) -> None:
    """Refuse a dataset without the texts that a policy is to learn from, before anything is made of it.

    Raises:
        MemobenchError: it has no subgoals at the level that memory is aligned with, or no oracle memory.
    """
    column = LEVEL_COLUMNS[config.subgoal_level]
    if config.align != "none" and not holds_texts(root, column):
        others = [level for level, name in LEVEL_COLUMNS.items() if holds_texts(root, name)]
        cure = (
            f"it has {' and '.join(others)} ones: name one with --policy.subgoal_level"
            if others
            else ("use --policy.align=none, which needs none, or a dataset that names each frame's subgoal there")
        )
        raise MemobenchError(
            f"The dataset {root} has no {config.subgoal_level} subgoals (no text in a column '{column}'), so "
            f"--policy.align={config.align} has nothing to align memory to; {cure}."
        )
    if config.oracle_memory and not holds_texts(root, MEMORY_COLUMN):
        raise MemobenchError(
            f"The dataset {root} has no text in a column '{MEMORY_COLUMN}', which --policy.oracle_memory=true reads; "
            "leave it out, or generate the dataset again with this version."
        )


def text_rows(cache: FrameLookup, level: str, align: str, shuffle_seed: int | None) -> np.ndarray:
    """Return the row of the cache's embeddings for each frame of the dataset (N,), -1 where it has no subgoal.

    Args:
        level: subgoal level. align: the objective, for the message.
        shuffle_seed: shuffle subgoals by this seed (`shuffled_subgoals`), and say how; None leaves them in place.

    Raises:
        MemobenchError: the dataset has no texts, or one only, which cannot be shuffled.
    """
    rows = cache.text_rows(level)
    if len(cache.texts) == 0:
        raise MemobenchError(
            f"The dataset of {cache.folder} has no subgoal text, so --policy.align={align} has nothing to "
            "align to; use --policy.align=none, or a dataset with subgoals."
        )
    if shuffle_seed is None:
        return rows
    if len(np.unique(rows[rows >= 0])) < 2:
        raise MemobenchError(
            f"The dataset of {cache.folder} has one {level} subgoal, and --policy.shuffle_subgoals=true needs another "
            "one to put in its place; use a dataset of several tasks, or another --policy.subgoal_level."
        )
    shuffled, elsewhere = shuffled_subgoals(rows, cache.episodes, shuffle_seed)
    logger.info(
        "%s subgoals are shuffled: in %d of %d episodes among themselves; %d have fewer than %d, which would only be "
        "renamed, and get texts of other episodes",
        level,
        len(cache.episodes) - 1 - elsewhere,
        len(cache.episodes) - 1,
        elsewhere,
        SEVERAL,
    )
    return shuffled


def texts_of_frames(cache: FrameLookup, rows: np.ndarray, frames: Sequence[int]) -> dict[str, Tensor]:
    """Return the texts (B, d_t) of frames of the dataset, and which have one (B,); ``rows`` as from `text_rows`."""
    return _embed(cache, rows[np.asarray(frames)].astype(np.int64))


def texts_of_histories(
    cache: FrameLookup, rows: np.ndarray, histories: Sequence[np.ndarray], frames: int
) -> dict[str, Tensor]:
    """Return the texts (B, F, d_t) of remembered frames, right-padded to F, and which have one (B, F)."""
    padded = np.full((len(histories), frames), -1, dtype=np.int64)
    for sample, history in enumerate(histories):
        padded[sample, : len(history)] = rows[history]
    return _embed(cache, padded)


def _embed(cache: FrameLookup, rows: np.ndarray) -> dict[str, Tensor]:
    numbers = torch.from_numpy(rows)
    return {TEXT_MASK: numbers >= 0, TEXT: cache.text_embeddings[numbers.clamp(min=0)]}


def shuffled_subgoals(rows: np.ndarray, episodes: np.ndarray, seed: int = 7) -> tuple[np.ndarray, int]:
    """The paper's control: the subgoals of each episode change places, each keeping its number of frames or not.

    Two that change places do so alike in every episode of their task, and one cannot: texts would be renamed and tell
    what they told before. Episodes with fewer than `SEVERAL` take, each for itself, texts of other episodes instead:
    of other tasks where there are enough, else any of the dataset.

    Args:
        rows: (N,) text number per frame, -1 for none. episodes: (E + 1,) first frame of each episode.
        seed: which shuffle.

    Returns:
        (N,) text numbers, the same in every run with this seed, and the number of episodes that took texts of others.
    """
    shuffled, every, elsewhere = rows.copy(), np.unique(rows[rows >= 0]), 0
    for episode, (start, end) in enumerate(itertools.pairwise(episodes)):
        present = np.unique(rows[start:end])
        present = present[present >= 0]
        chance = np.random.default_rng([seed, episode])
        if len(present) >= SEVERAL:
            # A rotation of a random order moves every subgoal; a plain permutation could leave them where they were.
            order = chance.permutation(present)
            replaced, by = order, np.roll(order, 1)
        else:
            others = np.setdiff1d(every, present)
            pool = others if len(others) >= SEVERAL * len(present) else every
            replaced, by = present, chance.choice(pool, len(present), replace=False)
            elsewhere += 1
        replace = dict(zip(replaced.tolist(), by.tolist(), strict=True))
        shuffled[start:end] = [replace.get(row, -1) for row in rows[start:end].tolist()]
    return shuffled, elsewhere
