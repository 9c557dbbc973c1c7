"""Frames of a dataset in main memory: phases, texts and recorded numbers by global index, and samples of them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor
from torch.utils.data import Dataset

from lerobot_memobench.constants import OBS_PHASE, PROMPT
from lerobot_memobench.datasets.demonstration import HELD_COLUMN, LEVEL_COLUMNS, MEMORY_COLUMN
from lerobot_memobench.datasets.episodes import numbers, read_info, read_table, tables_of, texts
from lerobot_memobench.datasets.layout import OBJECTS, PRIVILEGED, objects_column
from lerobot_memobench.errors import MemobenchError

_PLACE = ("index", "episode_index", "frame_index")


@dataclass
class FrameTable:
    """Phases and texts of a dataset of E episodes and N frames."""

    episodes: np.ndarray  # (E + 1,) int64, first frame of each episode, and N
    phase: np.ndarray  # (N,) uint8
    held: np.ndarray  # (N,) bool, whether the scene is held in the execution
    subgoals: dict[str, list[str]]  # level to (N,) texts
    memory: list[str] | None  # (N,) oracle memory texts; None without this column

    @property
    def num_episodes(self) -> int:
        """Number of episodes."""
        return len(self.episodes) - 1

    @property
    def acts(self) -> np.ndarray:
        """(N,) bool, whether the action of a frame has an effect: frames to learn from."""
        return (self.phase != PROMPT) & ~self.held

    def runs(self, flags: np.ndarray) -> np.ndarray:
        """Return the first frames (R,) of the longest parts of episodes with equal flags (N,), and N."""
        return np.union1d(self.episodes, np.flatnonzero(np.diff(flags)) + 1).astype(np.int64)


def read_frame_table(root: Path) -> FrameTable:
    """Read phase, holds and subgoals of every frame; refuse frames not numbered 0, 1, 2, ... episode by episode."""
    wanted = {*_PLACE, OBS_PHASE, HELD_COLUMN, MEMORY_COLUMN, *LEVEL_COLUMNS.values()}
    table = read_table(root / "data", wanted.__contains__).sort_by("index")
    names = {*table.column_names}
    number = {name: numbers(table.column(name)).reshape(-1) for name in {*_PLACE, OBS_PHASE, HELD_COLUMN} & names}
    starts, expected = np.flatnonzero(number["frame_index"] == 0), np.arange(len(table))
    episode = np.searchsorted(starts, expected, "right") - 1
    if not (np.array_equal(number["index"], expected) and np.array_equal(number["episode_index"], episode)):
        raise MemobenchError(
            f"The frames of {root} are not numbered 0, 1, 2, ... episode by episode; write the dataset again."
        )
    return FrameTable(
        episodes=np.append(starts, len(table)).astype(np.int64),
        # Without these columns every frame is one of the execution.
        phase=number.get(OBS_PHASE, np.ones(len(table))).astype(np.uint8),
        held=number.get(HELD_COLUMN, np.zeros(len(table))).astype(np.bool_),
        subgoals={level: texts(table.column(name)) for level, name in LEVEL_COLUMNS.items() if name in names},
        memory=texts(table.column(MEMORY_COLUMN)) if MEMORY_COLUMN in names else None,
    )


def _resolve_subgoals(rows: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    # A frame without a text (-1) has that of the next annotated frame of its episode, or else of the last one (paper,
    # framewise alignment).
    resolved = rows.copy()
    for start, end in itertools.pairwise(episodes):
        annotated = np.flatnonzero(rows[start:end] >= 0)
        if len(annotated):
            following = np.searchsorted(annotated, np.arange(end - start)).clip(max=len(annotated) - 1)
            resolved[start:end] = rows[start:end][annotated[following]]
    return resolved


# --- lookup ---

Columns = Mapping[str, Tensor]  # column -> its numbers (N, ...) of every frame, in the order of the global index
Remember = Callable[[int, Sequence[int]], Tensor]
"""From (episode, slots) to remembered features (n, P, D); slot k is the episode's frame k * stride."""
Encoded = Callable[[Sequence[int]], Tensor]  # from global indices (n,) to features (n, ...) of those frames


class FrameLookup:
    """Phase, texts, recorded numbers and remembered features of every frame of a dataset.

    1,500 episodes of 500 frames with the slots of objects take 0.7 GiB of main memory.
    """

    def __init__(
        self,
        root: Path,
        table: FrameTable,
        *,
        stride: int = 1,  # distance between remembered frames
        texts: Callable[[Sequence[str]], Tensor] | None = None,  # encoder of the subgoals; None: without embeddings
        remember: Remember | None = None,  # None: frames are not remembered
        columns: Columns | None = None,  # for training samples; None: LeRobot makes the samples
        encoded: Mapping[str, Encoded] | None = None,  # name in a training sample -> features of the present frame
    ) -> None:
        self.root, self.stride = root, stride
        self.episodes, self.phase, self.acts = table.episodes, table.phase, table.acts
        self.runs = table.runs(table.held)  # first frames of the parts of episodes between holds, and of the holds
        # Distinct subgoals, whose embeddings are `text_embeddings`; `memories` are the distinct oracle memory texts.
        self.texts = sorted({text for values in table.subgoals.values() for text in values if text})
        number = {text: row for row, text in enumerate(self.texts)}
        rows = {level: [number.get(text, -1) for text in values] for level, values in table.subgoals.items()}
        self._subgoal_rows = {
            level: _resolve_subgoals(np.array(column, np.int32), table.episodes) for level, column in rows.items()
        }
        self.text_embeddings = texts(self.texts) if texts is not None and self.texts else torch.zeros(0)
        self.memories: list[str] = []
        self._memory_rows: np.ndarray | None = None
        if table.memory is not None:  # as objects: NumPy's own texts would each be as wide as the longest
            memories, self._memory_rows = np.unique(np.array(table.memory, dtype=object), return_inverse=True)
            self.memories = memories.tolist()
        self.columns: Columns = columns or {}
        self.encoded: Mapping[str, Encoded] = encoded or {}
        self._remember = remember
        self._changes: dict[int, np.ndarray] = {}

    @property
    def num_frames(self) -> int:
        """Frames of the dataset."""
        return int(self.episodes[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Return the episode and the frame in it of a global index, which the dataset must have."""
        if not 0 <= index < self.num_frames:
            raise MemobenchError(
                f"frame {index} is outside the dataset {self.root}, which has {self.num_frames} frames; train and look "
                "up on the same dataset"
            )
        episode = int(np.searchsorted(self.episodes, index, "right")) - 1
        return episode, index - int(self.episodes[episode])

    def run_of(self, index: int) -> tuple[int, int]:
        """Return the bounds of the part of an episode between two holds, or of the hold, with a global index."""
        self.locate(index)
        following = int(np.searchsorted(self.runs, index, "right"))
        return int(self.runs[following - 1]), int(self.runs[following])

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Return the remembered features (n, P, D) of an episode's slots (`Remember`)."""
        assert self._remember is not None
        return self._remember(episode, slots)

    def changes(self, episode: int) -> np.ndarray:
        """Return the slots of an episode whose remembered features differ from those of the slot before."""
        if episode not in self._changes:
            slots = range(0, int(self.episodes[episode + 1] - self.episodes[episode]), self.stride)
            frames = self.tokens(episode, range(len(slots))).flatten(1)
            differs = (frames[1:] != frames[:-1]).any(dim=1).numpy()
            self._changes[episode] = np.flatnonzero(np.append(True, differs))
        return self._changes[episode]

    def memory_texts(self, indices: Sequence[int]) -> list[str]:
        """Return the oracle memory texts of frames by their global indices."""
        if self._memory_rows is None:
            raise MemobenchError(
                f"the dataset {self.root} has no column '{MEMORY_COLUMN}', which --policy.oracle_memory=true reads; "
                "generate it again with this version"
            )
        return [self.memories[row] for row in self._memory_rows[np.asarray(indices, dtype=np.int64)].tolist()]

    def text_rows(self, level: str) -> np.ndarray:
        """Return the row of `text_embeddings` for each frame (N,) int32; -1 for a frame without a text."""
        if level not in self._subgoal_rows:
            known = ", ".join(self._subgoal_rows) or "none"
            raise MemobenchError(
                f"the dataset {self.root} has no subgoals at level '{level}' (column {LEVEL_COLUMNS[level]}); its "
                f"levels: {known}; choose one with --policy.subgoal_level"
            )
        return self._subgoal_rows[level]


def read_recorded(root: Path, names: Sequence[str]) -> tuple[dict[str, Tensor], FrameTable]:
    """Read columns of numbers, each (N, ...), and phases and texts of a dataset.

    `OBJECTS` names the objects, whichever column of the dataset holds them.
    """
    table = read_frame_table(root)
    columns: dict[str, np.ndarray] = {}
    wanted = {"index", *names} | ({PRIVILEGED} if OBJECTS in names else set())
    for _, part in tables_of(root / "data", wanted.__contains__):
        column_of = {name: objects_column(part.column_names) if name == OBJECTS else name for name in names}
        missing = [name for name in column_of.values() if name not in part.column_names]
        if missing:
            raise MemobenchError(
                f"The dataset {root} has no column '{missing[0]}', which this policy learns from; generate it again "
                "with this version, or train with --policy.perception=pixels and no --policy.detection_noise."
            )
        index = part.column("index").to_numpy()
        for name, stored in column_of.items():
            values = numbers(part.column(stored))
            column = columns.setdefault(name, np.empty((len(table.phase), *values.shape[1:]), values.dtype))
            column[index] = values
    return {name: torch.from_numpy(column) for name, column in columns.items()}, table


def repeated(root: Path) -> np.ndarray:
    """Return whether each frame (N,) has the state and objects of the one before: the scene is at rest.

    Its image is the same, too, but a decoded video differs a little. Without a column of objects no frame is repeated.
    """
    features = read_info(root)["features"]
    if objects_column(features) not in features:
        return np.zeros(read_frame_table(root).episodes[-1], np.bool_)
    columns, table = read_recorded(root, ["observation.state", OBJECTS])
    same = np.ones(len(table.phase), np.bool_)
    for column in columns.values():
        same[1:] &= (column[1:] == column[:-1]).all(dim=1).numpy()
    same[table.episodes[:-1]] = False
    return same


# --- samples ---


class SamplesInMemory(Dataset[dict[str, Any]]):
    """LeRobot's samples by their rows, from columns in main memory, without images."""

    def __init__(
        self,
        columns: Mapping[str, Tensor],  # name -> numbers (N, ...)
        bounds: np.ndarray,  # first rows of the stretches in which a sample takes its other steps, and N
        steps: Mapping[str, Sequence[int]],  # name of a column -> its steps in a sample, relative to the sample's row
        tasks: Sequence[str],  # instructions by `task_index`
        texts: Mapping[str, pa.Array] | None = None,  # name -> further values (N,)
    ) -> None:
        self._columns, self._texts, self._tasks = columns, texts or {}, tasks
        self._bounds = torch.from_numpy(bounds)
        self._steps = {name: torch.tensor([*own]) for name, own in steps.items()}

    def __getitem__(self, row: int) -> dict[str, Any]:
        return self.__getitems__([row])[0]

    def __getitems__(self, rows: Sequence[int]) -> list[dict[str, Any]]:
        """Return the samples of several rows, each column read once."""
        index = torch.tensor(rows)
        samples = {name: column[index] for name, column in self._columns.items() if name not in self._steps}
        following = torch.searchsorted(self._bounds, index, right=True)
        first, end = self._bounds[following - 1, None], self._bounds[following, None]
        for name, steps in self._steps.items():
            wanted = index[:, None] + steps
            samples[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
            if name in self._columns:
                samples[name] = self._columns[name][wanted.clamp(first, end - 1)]
        parts: dict[str, Any] = {name: values.unbind() for name, values in samples.items()}
        parts |= {name: values.take(pa.array(rows)).to_pylist() for name, values in self._texts.items()}
        parts["task"] = [self._tasks[number] for number in samples["task_index"].tolist()]
        return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]
