"""What training looks up of a dataset whose frames are remembered as they were recorded: all of it, in main memory.

Nothing is encoded, no picture is read, and nothing is written to a disk. 1,500 episodes of 500 frames with the slots of
objects take 0.7 GiB.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frame_table import FrameTable, read_frame_table, resolve_subgoals
from lerobot_memobench.datasets.feature_cache.layout import FORMAT, CacheMeta, slot_starts
from lerobot_memobench.datasets.feature_cache.lookup import FrameLookup
from lerobot_memobench.datasets.feature_cache.tables import TextEncoder, numbered, numbered_memory
from lerobot_memobench.datasets.lerobot_format.info import undamaged
from lerobot_memobench.datasets.lerobot_format.layout import OBJECTS, objects_column
from lerobot_memobench.errors import MemobenchError

Columns = Mapping[str, Tensor]
"""Column -> its numbers (N, ...) of every frame, in the order of the global index."""


class RecordedTexts(FrameLookup):
    """A dataset's phases and texts, for a policy that remembers nothing of its frames."""

    def __init__(self, root: Path, table: FrameTable) -> None:
        self.folder = self.root = root
        self.episodes, self.phase = table.episodes, table.phase
        self.texts, rows = numbered(table)
        self.subgoal_rows = {level: resolve_subgoals(found, table.episodes) for level, found in rows.items()}
        self.memories, self.memory_rows = ([], None) if table.memory is None else numbered_memory(table.memory)

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Refuse: there are none."""
        raise LookupError("nothing is remembered of these frames")


class RecordedFrames(RecordedTexts):
    """A dataset's columns, and its texts.

    Args:
        root: folder of the dataset. columns: of which frames are remembered.
        table: its phases and texts. texts: the text encoder.
        remember: from the columns and numbers of frames (n,) to what is remembered of them (n, P, D).
        key: identity of what is remembered. stride: every how many frames one is.
    """

    def __init__(
        self,
        root: Path,
        columns: Columns,
        table: FrameTable,
        texts: TextEncoder,
        *,
        remember: Callable[[Columns, Sequence[int]], Tensor],
        key: str,
        stride: int,
    ) -> None:
        super().__init__(root, table)
        self.columns, self._remember = columns, remember
        self.text_embeddings = texts(self.texts) if self.texts else torch.zeros(0, texts.dim)
        _, count, dim = remember(columns, [0]).shape
        self.meta = CacheMeta(
            format=FORMAT,
            dataset="",
            frames_key=key,
            texts_key=texts.key,
            camera="",
            stride=stride,
            tokens_per_frame=count,
            dim=dim,
            slots=int(slot_starts(table.episodes, stride)[-1]),
            levels=list(self.subgoal_rows),
            oracle=table.memory is not None,
            complete=True,
        )

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """What is remembered (n, P, D) of stored frames of an episode; slot k is its frame k * stride."""
        first = int(self.episodes[episode])
        return self._remember(self.columns, [first + slot * self.meta.stride for slot in slots])


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
        _require(root, list(column_of.values()), there)
        with undamaged(path):
            part = pq.read_table(path, columns=sorted({"index", *column_of.values()}))
        places = part.column("index").to_numpy()
        for name in names:
            numbers = _numbers(part.column(column_of[name]))
            column = columns.setdefault(name, np.empty((frames, *numbers.shape[1:]), numbers.dtype))
            column[places] = numbers
    return {name: torch.from_numpy(column) for name, column in columns.items()}, table


def _require(root: Path, names: Sequence[str], there: Sequence[str]) -> None:
    missing = [name for name in names if name not in there]
    if missing:
        raise MemobenchError(
            f"The dataset {root} has no column '{missing[0]}', which this policy learns from; make it again with this "
            "version's `memobench generate`, or train with --policy.perception=pixels and no --policy.sight_errors."
        )


def _numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Numbers (n,), or (n, d) of a column of lists of one length."""
    if not (pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)):
        return np.asarray(column.to_numpy())
    return np.asarray(column.combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)
