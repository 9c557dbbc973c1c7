"""Look up phase, texts, recorded numbers and remembered features of a dataset's frames, by their global indices."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from lerobot_memobench.datasets.frames import (
    LEVEL_COLUMNS,
    MEMORY_COLUMN,
    FrameTable,
    TextEncoder,
    numbered,
    numbered_memory,
    read_frame_table,
    resolve_subgoals,
)
from lerobot_memobench.datasets.lerobot_format.layout import OBJECTS, objects_column, undamaged
from lerobot_memobench.errors import MemobenchError

Columns = Mapping[str, Tensor]
"""Column -> its numbers (N, ...) of every frame, in the order of the global index."""
Remember = Callable[[int, Sequence[int]], Tensor]
"""From (episode, slots) to the remembered features (n, P, D); slot k is the episode's frame k * stride."""
Encoded = Callable[[Sequence[int]], Tensor]
"""From global indices (n,) to features (n, ...) of those frames."""


class FrameLookup:
    """Phase, texts, recorded numbers and remembered features of every frame of a dataset.

    1,500 episodes of 500 frames with the slots of objects take 0.7 GiB of main memory.

    Args:
        root: folder of the dataset. table: its phases and texts.
        stride: every how many frames one is remembered.
        texts: encoder of the subgoals; None: they have no embeddings.
        remember: features of remembered frames; None: nothing is remembered.
        columns: recorded numbers of which training samples are made; None: LeRobot makes the samples.
        encoded: name in a training sample -> features of the present frame.

    Attributes:
        episodes: (E + 1,) first frame of each episode. phase: (N,) 0 in the prompt.
        texts: the distinct subgoals. text_embeddings: (texts, d_t).
        memories: the distinct oracle memory texts.
    """

    def __init__(
        self,
        root: Path,
        table: FrameTable,
        *,
        stride: int = 1,
        texts: TextEncoder | None = None,
        remember: Remember | None = None,
        columns: Columns | None = None,
        encoded: Mapping[str, Encoded] | None = None,
    ) -> None:
        self.root, self.stride = root, stride
        self.episodes, self.phase = table.episodes, table.phase
        self.texts, rows = numbered(table)
        self._subgoal_rows = {level: resolve_subgoals(found, table.episodes) for level, found in rows.items()}
        width = 0 if texts is None else texts.dim
        self.text_embeddings = texts(self.texts) if texts is not None and self.texts else torch.zeros(0, width)
        self.memories: list[str] = []
        self._memory_rows: np.ndarray | None = None
        if table.memory is not None:
            self.memories, self._memory_rows = numbered_memory(table.memory)
        self.columns: Columns = columns or {}
        self.encoded: Mapping[str, Encoded] = encoded or {}
        self._remember = remember

    @property
    def num_frames(self) -> int:
        """Frames of the dataset."""
        return int(self.episodes[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Return the episode and the frame in it of a global index.

        Raises:
            MemobenchError: the dataset has no such frame.
        """
        if not 0 <= index < self.num_frames:
            raise MemobenchError(
                f"frame {index} lies outside the dataset {self.root}, which has {self.num_frames} frames; train and "
                "look up on the same dataset"
            )
        episode = int(np.searchsorted(self.episodes, index, "right")) - 1
        return episode, index - int(self.episodes[episode])

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Return the remembered features (n, P, D) of an episode's slots; slot k is its frame k * stride."""
        if self._remember is None:
            raise LookupError("nothing is remembered of these frames")
        return self._remember(episode, slots)

    def memory_texts(self, indices: Sequence[int]) -> list[str]:
        """Return the oracle memory texts of frames by their global indices.

        Raises:
            MemobenchError: the dataset has no such column.
        """
        if self._memory_rows is None:
            raise MemobenchError(
                f"the dataset {self.root} has no column '{MEMORY_COLUMN}', which --policy.oracle_memory=true reads; "
                "generate it again with this version"
            )
        return [self.memories[row] for row in self._memory_rows[np.asarray(indices, dtype=np.int64)].tolist()]

    def text_rows(self, level: str) -> np.ndarray:
        """Return the row of `text_embeddings` for each frame (N,) int32; -1 for a frame without a text.

        Raises:
            MemobenchError: the dataset has no texts at this level.
        """
        if level not in self._subgoal_rows:
            known = ", ".join(self._subgoal_rows) or "none"
            raise MemobenchError(
                f"the dataset {self.root} has no subgoals at level '{level}' (column {LEVEL_COLUMNS[level]}); its "
                f"levels: {known}; choose one with --policy.subgoal_level"
            )
        return self._subgoal_rows[level]


def read_recorded(root: Path, names: Sequence[str]) -> tuple[dict[str, Tensor], FrameTable]:
    """Read columns of numbers, each (N, ...), and phases and texts of a dataset.

    Objects are read by the observation's name, whatever the dataset's column is called.

    Raises:
        MemobenchError: a column is missing, or frames are not numbered 0, 1, 2, ...
    """
    table = read_frame_table(root)
    frames = int(table.episodes[-1])
    columns: dict[str, np.ndarray] = {}
    for path in sorted((root / "data").rglob("*.parquet")):
        with undamaged(path):
            there = pq.read_schema(path).names
        column_of = {name: objects_column(there) if name == OBJECTS else name for name in names}
        missing = [name for name in column_of.values() if name not in there]
        if missing:
            raise MemobenchError(
                f"The dataset {root} has no column '{missing[0]}', which this policy learns from; make it again with "
                "this version's `memobench generate`, or train with --policy.perception=pixels and no "
                "--policy.detection_noise."
            )
        with undamaged(path):
            part = pq.read_table(path, columns=sorted({"index", *column_of.values()}))
        places = part.column("index").to_numpy()
        for name in names:
            numbers = _numbers(part.column(column_of[name]))
            column = columns.setdefault(name, np.empty((frames, *numbers.shape[1:]), numbers.dtype))
            column[places] = numbers
    return {name: torch.from_numpy(column) for name, column in columns.items()}, table


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return numbers (n,), or (n, d) of a column of lists of one length."""
    if not (pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)):
        return np.asarray(column.to_numpy())
    return np.asarray(column.combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)
