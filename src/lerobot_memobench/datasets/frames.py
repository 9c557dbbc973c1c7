"""Frames of a dataset: phase and texts of each, in the order of its global index; pictures of a camera, decoded."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch
from torch import Tensor

from lerobot_memobench.datasets.lerobot_format.layout import (
    check_clock,
    naming_damage,
    undamaged,
    without_pattern,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import OBS_PHASE

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

LEVEL_COLUMNS = {"coarse": "coarse_subgoal", "intermediate": "simple_subgoal", "fine": "grounded_subgoal"}
MEMORY_COLUMN = "memory"
_PLACE = ("index", "episode_index", "frame_index")
TOLERANCE = 1e-4
"""Seconds by which a decoded frame may miss its time."""
FrameReader = Callable[[int, list[int]], Any]
"""From (episode, frame numbers) to images (n, 3, H, W) float32 in [0, 1], or to what an encoder is given for them."""


# --- phase and texts ---


@dataclass
class FrameTable:
    """Columns of a dataset that a cache keeps.

    Attributes:
        episodes: (E + 1,) int64, first frame of each episode.
        phase: (N,) uint8.
        subgoals: level to (N,) texts.
        memory: (N,) oracle memory texts; None without the column.
    """

    episodes: np.ndarray
    phase: np.ndarray
    subgoals: dict[str, list[str]]
    memory: list[str] | None

    @property
    def num_episodes(self) -> int:
        """E."""
        return len(self.episodes) - 1


def read_frame_table(root: Path) -> FrameTable:
    """Read phase and subgoals of every frame.

    Raises:
        MemobenchError: the frames are not numbered 0, 1, 2, ... or an episode is not contiguous.
    """
    table = _read_columns(root, [OBS_PHASE, MEMORY_COLUMN, *LEVEL_COLUMNS.values()])
    there = set(table.column_names)
    return FrameTable(
        episodes=_episodes(root, table),
        phase=(_numbers(table, OBS_PHASE) if OBS_PHASE in there else np.ones(len(table))).astype(np.uint8),
        subgoals={level: _texts(table, name) for level, name in LEVEL_COLUMNS.items() if name in there},
        memory=_texts(table, MEMORY_COLUMN) if MEMORY_COLUMN in there else None,
    )


def holds_texts(root: Path, column: str) -> bool:
    """Return whether a dataset has a column of texts that is not empty throughout."""
    for path in sorted((root / "data").rglob("*.parquet")):
        if column in pq.read_schema(path).names and any(_texts(pq.read_table(path, columns=[column]), column)):
            return True
    return False


def _read_columns(root: Path, optional: list[str]) -> pa.Table:
    """Each frame's place, and those of the optional columns that are there."""
    files = sorted((root / "data").rglob("*.parquet"))
    if not files:
        raise MemobenchError(f"{root} holds no frames: there is no parquet file below {root / 'data'}.")
    with undamaged(files[0]):
        present = pq.read_schema(files[0]).names
    check_clock(present, root)
    columns = [*_PLACE, *(name for name in optional if name in present)]
    tables = []
    for path in files:
        with undamaged(path):
            tables.append(pq.read_table(path, columns=columns))
    return pa.concat_tables(tables, promote_options="permissive").sort_by("index")


def _episodes(root: Path, table: pa.Table) -> np.ndarray:
    index, episode, frame = (_numbers(table, name) for name in _PLACE)
    starts = np.flatnonzero(frame == 0)
    expected = np.arange(len(index))
    if not np.array_equal(index, expected) or not np.array_equal(
        episode, np.searchsorted(starts, expected, "right") - 1
    ):
        raise MemobenchError(
            f"The frames of {root} are not numbered 0, 1, 2, ... episode by episode; write the dataset again."
        )
    return np.append(starts, len(index)).astype(np.int64)


def _numbers(table: pa.Table, name: str) -> np.ndarray:
    return np.asarray(table.column(name).to_pylist()).reshape(-1)


def _texts(table: pa.Table, name: str) -> list[str]:
    """String columns arrive as strings or as lists of one string; a missing one is empty."""
    values = table.column(name).to_pylist()
    return [(value[0] if isinstance(value, list) else value) or "" for value in values]


def resolve_subgoals(rows: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Give frames without a text the text of the next annotated step of their episode, or else of the last one.

    Args:
        rows: (N,) text number per frame, -1 where a frame has none.
        episodes: (E + 1,) first frame of each episode.

    Returns:
        (N,) text numbers; -1 is left only in episodes without any text (paper, framewise alignment).
    """
    resolved = rows.copy()
    for start, end in itertools.pairwise(episodes):
        annotated = np.flatnonzero(rows[start:end] >= 0)
        if len(annotated) == 0:
            continue
        following = np.searchsorted(annotated, np.arange(end - start)).clip(max=len(annotated) - 1)
        resolved[start:end] = rows[start:end][annotated[following]]
    return resolved


def numbered(table: FrameTable) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return the subgoals that there are, and for each level their rows (N,) int32, -1 for none."""
    unique = sorted({text for values in table.subgoals.values() for text in values if text})
    number = {text: row for row, text in enumerate(unique)}
    rows = {level: [number.get(text, -1) for text in values] for level, values in table.subgoals.items()}
    return unique, {level: np.array(found, np.int32) for level, found in rows.items()}


def numbered_memory(memory: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Return the oracle memory texts that there are, and the row (N,) int32 of each frame's."""
    memories, rows = np.unique(np.array(memory, dtype=object), return_inverse=True)
    return memories.tolist(), rows.astype(np.int32)


class TextEncoder(Protocol):
    """The frozen text encoder: texts -> embeddings (N, dim) float32."""

    @property
    def key(self) -> str:
        """Identity of the encoder."""

    @property
    def dim(self) -> int:
        """Width of an embedding."""

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Encode."""


# --- pictures ---


def frame_reader(root: Path, camera: str) -> FrameReader:
    """Return the reader of a camera of the dataset in ``root``; it decodes what it is asked for in one sweep.

    Raises:
        MemobenchError: the dataset has no such camera, or no pictures at all, or its metadata is damaged.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    with naming_damage(root):
        meta = LeRobotDatasetMetadata(root.name, root=without_pattern(root))
    if not meta.camera_keys:
        raise MemobenchError(
            f"{root} holds no pictures, which a detector and perception=pixels need; name a dataset with pictures, or "
            "leave detector out at perception=objects"
        )
    if camera not in meta.camera_keys:
        raise MemobenchError(
            f"The dataset {root} has no camera '{camera}'; it has {', '.join(meta.camera_keys)}. "
            "Choose one with --policy.memory_camera."
        )
    return (_video_reader if camera in meta.video_keys else _image_reader)(root, camera, meta)


def _video_reader(root: Path, camera: str, meta: LeRobotDatasetMetadata) -> FrameReader:
    height, width, channels = meta.features[camera]["shape"]
    decode = _decoder()
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            row = meta.episodes[episode]
            path = root / meta.get_video_file_path(episode, camera)
        start = row[f"videos/{camera}/from_timestamp"]
        with undamaged(path):
            images = decode(path, [start + number / meta.fps for number in numbers])
            return images.reshape(len(numbers), channels, height, width)

    return read


def _decoder() -> Callable[[Path, list[float]], Tensor]:
    """Function from a video and times in it, s, to its frames."""
    from lerobot.datasets import video_utils

    backend = video_utils.get_safe_default_video_backend()
    own = threading.local()

    def decode(path: Path, times: list[float]) -> Tensor:
        if backend != "torchcodec":
            return video_utils.decode_video_frames(path, times, tolerance_s=TOLERANCE, backend=backend)
        # LeRobot's decoders are shared within a process, and none may be used by two threads at a time.
        if not hasattr(own, "decoders"):
            own.decoders = video_utils.VideoDecoderCache(max_size=1)
        return video_utils.decode_video_frames_torchcodec(path, times, TOLERANCE, decoder_cache=own.decoders)

    return decode


def _image_reader(root: Path, camera: str, meta: LeRobotDatasetMetadata) -> FrameReader:
    """Reader of datasets that keep images in their tables."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=without_pattern(root))
    starts = meta.episodes["dataset_from_index"]
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            return torch.stack([dataset[starts[episode] + number][camera] for number in numbers])

    return read
