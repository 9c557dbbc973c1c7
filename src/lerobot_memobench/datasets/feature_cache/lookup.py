"""What training looks up of a dataset's frames by their global index, wherever their memory comes from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frame_table import LEVEL_COLUMNS, MEMORY_COLUMN
from lerobot_memobench.datasets.feature_cache.layout import CacheMeta, fix_hint
from lerobot_memobench.errors import MemobenchError


class FrameLookup(ABC):
    """Phase, texts and memory of every frame of a dataset.

    Attributes:
        folder: what messages name. root: the dataset's.
        episodes: (E + 1,) first frame of each episode. phase: (N,) 0 in the prompt.
        texts: the subgoals that there are. text_embeddings: (texts, d_t).
        memories: the oracle memory texts that there are.
    """

    folder: Path
    root: Path
    meta: CacheMeta
    episodes: np.ndarray
    phase: np.ndarray
    texts: list[str]
    text_embeddings: Tensor
    memories: list[str]
    subgoal_rows: dict[str, np.ndarray]
    memory_rows: np.ndarray | None

    @abstractmethod
    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """What is remembered (n, P, D) of stored frames of an episode; slot k is its frame k * stride."""

    @property
    def num_frames(self) -> int:
        """Frames of the dataset."""
        return int(self.episodes[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Episode and frame in it, of a frame of the dataset's global index."""
        if not 0 <= index < self.num_frames:
            raise MemobenchError(
                f"Frame {index} lies outside the memory cache {self.folder}, which has {self.num_frames} frames. "
                f"{fix_hint(self.root)}"
            )
        episode = int(np.searchsorted(self.episodes, index, "right")) - 1
        return episode, index - int(self.episodes[episode])

    def memory_texts(self, indices: Sequence[int]) -> list[str]:
        """Oracle memory texts of frames of the dataset, by their global indices.

        Raises:
            MemobenchError: the dataset has no such column.
        """
        if self.memory_rows is None:
            raise MemobenchError(
                f"The dataset of {self.folder} has no column '{MEMORY_COLUMN}', which --policy.oracle_memory=true "
                "reads; generate it again with this version."
            )
        return [self.memories[row] for row in self.memory_rows[np.asarray(indices, dtype=np.int64)].tolist()]

    def text_rows(self, level: str) -> np.ndarray:
        """(N,) int32: row of :attr:`text_embeddings` for each frame of the dataset; -1 where there is none.

        Raises:
            MemobenchError: the dataset has no texts at this level.
        """
        if level not in self.subgoal_rows:
            known = ", ".join(self.subgoal_rows) or "none"
            raise MemobenchError(
                f"The dataset of {self.folder} has no subgoals at level '{level}' (column {LEVEL_COLUMNS[level]}); "
                f"levels it has: {known}. Choose one with --policy.subgoal_level."
            )
        return self.subgoal_rows[level]
