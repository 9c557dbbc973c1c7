"""Look up phase, texts and memory of a dataset's frames: from a feature cache, or from the recorded columns."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frames import (
    LEVEL_COLUMNS,
    MEMORY_COLUMN,
    FrameTable,
    TextEncoder,
    numbered,
    numbered_memory,
    read_frame_table,
    resolve_subgoals,
)
from lerobot_memobench.datasets.feature_cache.layout import (
    FOLDER,
    FORMAT,
    TEXTS_FILE,
    TOKENS_FILE,
    CacheMeta,
    dataset_fingerprint,
    fix_hint,
    read_meta,
    slot_starts,
    texts_file,
)
from lerobot_memobench.datasets.lerobot_format.layout import OBJECTS, objects_column, undamaged
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_name, read_json

Columns = Mapping[str, Tensor]
"""Column -> its numbers (N, ...) of every frame, in the order of the global index."""


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
                f"Frame {index} lies outside the feature cache {self.folder}, which has {self.num_frames} frames. "
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


class FeatureCache(FrameLookup):
    """A complete cache, read through memory maps. Open one with :meth:`open`."""

    def __init__(self, folder: Path, meta: CacheMeta, texts_key: str | None = None) -> None:
        self.folder, self.root, self.meta = folder, folder.parent.parent, meta
        self.episodes: np.ndarray = np.load(folder / "episodes.npy")
        self.phase: np.ndarray = np.load(folder / "phase.npy")
        self.slots = slot_starts(self.episodes, meta.stride)
        self._tokens = np.memmap(folder / TOKENS_FILE, dtype=np.uint16, mode="r", shape=meta.shape)
        self.subgoal_rows = {
            level: resolve_subgoals(
                np.load(folder / file_name(f"subgoal-{level}.npy", "the table of a level")), self.episodes
            )
            for level in meta.levels
        }
        self.texts: list[str] = read_json(folder / TEXTS_FILE, list[str], "it is damaged")
        embeddings = folder / texts_file(meta.texts_key, texts_key or meta.texts_key)
        self.text_embeddings = torch.from_numpy(np.load(embeddings))
        self.memory_rows = np.load(folder / "memory.npy") if meta.oracle else None
        self.memories: list[str] = read_json(folder / "memory.json", list[str], "it is damaged") if meta.oracle else []
        self._check()

    def _check(self) -> None:
        """Raise a ValueError unless the tables are those of one dataset."""
        frames, episodes = self.num_frames, len(self.episodes)
        tables = [(rows, len(self.texts)) for rows in self.subgoal_rows.values()]
        tables += [] if self.memory_rows is None else [(self.memory_rows, len(self.memories))]
        fitting = (
            episodes > 0
            and (np.diff(self.episodes) > 0).all()
            and (self.episodes[0], self.slots[-1]) == (0, self.meta.slots)
            and self.phase.shape == (frames,)
            and self.text_embeddings.shape[:1] == (len(self.texts),)
            and all(rows.shape == (frames,) and rows.max(initial=-1) < count for rows, count in tables)
        )
        if not fitting:
            raise ValueError("its tables are not of one dataset")

    @classmethod
    def open(
        cls,
        root: Path,
        name: str,
        *,
        frames_key: str,
        camera: str,
        stride: int,
        texts_key: str | None = None,
        place: Path | None = None,
    ) -> FeatureCache:
        """Open ``<root>/feature_cache/<name>`` after checking that it fits.

        Args:
            root: folder of the LeRobotDataset.
            frames_key: identity of the visual encoder that will read the cache.
            texts_key: identity of the text encoder; None when no text is needed.
            place: folder that holds caches, where it is not the one beside the dataset.

        Raises:
            MemobenchError: no cache, an unfinished one, one of another dataset (stale), or one made by another encoder,
                camera, stride or text encoder (foreign). The message names the reason and the fix.
        """
        root = Path(root)
        meta, folder = read_meta(root, name, place), (place or root / FOLDER) / name
        if meta is None:
            raise MemobenchError(f"{folder.parent} has no feature cache '{name}'. {fix_hint(root)}")
        wanted = {
            "format": FORMAT,
            "dataset": dataset_fingerprint(root, camera),
            "frames_key": frames_key,
            "camera": camera,
            "stride": stride,
        }
        reason = meta.mismatch(wanted)
        if reason is None and texts_key is not None and not (folder / texts_file(meta.texts_key, texts_key)).is_file():
            reason = "is foreign: another text encoder made it"
        if reason:
            raise MemobenchError(f"The feature cache {folder} {reason}. {fix_hint(root)}")
        if not meta.complete:
            raise MemobenchError(f"The feature cache {folder} is not finished. Go on with `memobench cache {root}`.")
        try:
            return cls(folder, meta, texts_key)
        except Exception as error:  # NumPy answers damaged arrays with errors of every type
            told = " ".join(str(error).split())[:200]
            raise MemobenchError(
                f"The feature cache {folder} is damaged ({told}). Delete that folder. {fix_hint(root)}"
            ) from None

    def all_tokens(self) -> Tensor:
        """Tokens (slots, P, D) bfloat16 of all stored frames, mapped: read where they are looked at."""
        path, shape = self.folder / TOKENS_FILE, self.meta.shape
        return torch.from_file(str(path), size=math.prod(shape), dtype=torch.bfloat16).view(shape)

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Tokens (n, P, D) bfloat16 of stored frames of an episode; slot k is its frame k * stride."""
        rows = np.asarray(slots, dtype=np.int64) + self.slots[episode]
        return torch.from_numpy(self._tokens[rows]).view(torch.bfloat16)


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
    """A dataset's columns and texts, in main memory: nothing is encoded, and nothing is written to a disk.

    1,500 episodes of 500 frames with the slots of objects take 0.7 GiB.

    Args:
        root: folder of the dataset. columns: of which samples are made.
        table: its phases and texts. texts: the text encoder.
        remember: from numbers of frames (n,) to what is remembered of them (n, P, D).
        key: identity of what is remembered. stride: every how many frames one is.
    """

    def __init__(
        self,
        root: Path,
        columns: Columns,
        table: FrameTable,
        texts: TextEncoder,
        *,
        remember: Callable[[Sequence[int]], Tensor],
        key: str,
        stride: int,
    ) -> None:
        super().__init__(root, table)
        self.columns, self._remember = columns, remember
        self.text_embeddings = texts(self.texts) if self.texts else torch.zeros(0, texts.dim)
        _, count, dim = remember([0]).shape
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
        return self._remember([first + slot * self.meta.stride for slot in slots])


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
    """Numbers (n,), or (n, d) of a column of lists of one length."""
    if not (pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type)):
        return np.asarray(column.to_numpy())
    return np.asarray(column.combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)
