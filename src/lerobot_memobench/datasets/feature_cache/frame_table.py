"""What a dataset says of each of its frames, in the order of its global index."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from lerobot_memobench.datasets.lerobot_format.info import undamaged
from lerobot_memobench.errors import MemobenchError

LEVEL_COLUMNS = {"coarse": "coarse_subgoal", "intermediate": "simple_subgoal", "fine": "grounded_subgoal"}
MEMORY_COLUMN = "memory"
_PLACE = ("index", "episode_index", "frame_index")


@dataclass
class FrameTable:
    """The columns that a cache keeps.

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
    table = _read_columns(root, ["phase", MEMORY_COLUMN, *LEVEL_COLUMNS.values()])
    there = set(table.column_names)
    return FrameTable(
        episodes=_episodes(root, table),
        phase=(_numbers(table, "phase") if "phase" in there else np.ones(len(table))).astype(np.uint8),
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
