"""The subgoal texts that training samples are aligned with: one per sample, or one per remembered frame."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import FrameLookup
from lerobot_memobench.datasets.memory_cache.frame_table import LEVEL_COLUMNS, MEMORY_COLUMN, holds_texts
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.batch import TEXT, TEXT_MASK


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
        shuffle_seed: shuffle subgoals within episodes by this seed; None leaves them in place.

    Raises:
        MemobenchError: the dataset has no texts.
    """
    rows = cache.text_rows(level)
    if len(cache.texts) == 0:
        raise MemobenchError(
            f"The dataset of {cache.folder} has no subgoal text, so --policy.align={align} has nothing to "
            "align to; use --policy.align=none, or a dataset with subgoals."
        )
    return rows if shuffle_seed is None else shuffle_within_episodes(rows, cache.episodes, shuffle_seed)


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


def shuffle_within_episodes(rows: np.ndarray, episodes: np.ndarray, seed: int = 7) -> np.ndarray:
    """The paper's control: the subgoals of each episode change places, each keeping its number of frames or not.

    Args:
        rows: (N,) text number per frame, -1 for none. episodes: (E + 1,) first frame of each episode.
        seed: which shuffle.

    Returns:
        (N,) text numbers. Every subgoal of an episode with several is replaced by another one of the same episode; the
        same in every run with this seed.
    """
    shuffled = rows.copy()
    for episode, (start, end) in enumerate(itertools.pairwise(episodes)):
        present = np.unique(rows[start:end])
        present = present[present >= 0]
        # A rotation of a random order moves every subgoal; a plain permutation could leave them where they were.
        order = np.random.default_rng([seed, episode]).permutation(present)
        replace = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))
        shuffled[start:end] = [replace.get(row, -1) for row in rows[start:end].tolist()]
    return shuffled
