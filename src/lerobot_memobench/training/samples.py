"""Training samples: LeRobot's, decoded from videos or taken from main memory.

LeRobot decodes all videos of a sample, and reads a table for each time of each column of a history. Here numbers are
tensors and pictures are left out; all else of a sample equals LeRobot's to the bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from lerobot.datasets import LeRobotDataset
from lerobot.utils.constants import ACTION
from torch import Tensor
from torch.utils.data import Dataset

from lerobot_memobench.datasets.frames import FrameLookup
from lerobot_memobench.training.sampler import seed_of


class SamplesInMemory(Dataset[dict[str, Any]]):
    """LeRobot's samples by their rows, from columns in main memory, without pictures.

    Args:
        columns: name -> numbers (N, ...).
        bounds: first rows of the stretches in which a sample takes its other steps, and N.
        steps: name of a column -> its steps in a sample, relative to the sample's row.
        tasks: instructions by ``task_index``.
        texts: name -> further values (N,).
    """

    def __init__(
        self,
        columns: Mapping[str, Tensor],
        bounds: np.ndarray,
        steps: Mapping[str, Sequence[int]],
        tasks: Sequence[str],
        texts: Mapping[str, pa.Array] | None = None,
    ) -> None:
        self._columns, self._texts, self._tasks = columns, texts or {}, tasks
        self._bounds = torch.from_numpy(bounds)
        self._steps = {name: torch.tensor([*own]) for name, own in steps.items()}

    def __getitem__(self, row: int) -> dict[str, Any]:
        return self.__getitems__([row])[0]

    def __getitems__(self, rows: Sequence[int]) -> list[dict[str, Any]]:
        """Return the samples of several rows, each column read once."""
        at = torch.tensor(rows)
        found: dict[str, Any] = {name: column[at] for name, column in self._columns.items() if name not in self._steps}
        after = torch.searchsorted(self._bounds, at, right=True)
        first, end = self._bounds[after - 1, None], self._bounds[after, None]
        for name, steps in self._steps.items():
            wanted = at[:, None] + steps
            found[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
            if name in self._columns:
                found[name] = self._columns[name][wanted.clamp(first, end - 1)]
        parts: dict[str, Any] = {name: values.unbind() for name, values in found.items()}
        parts |= {name: values.take(pa.array(rows)).to_pylist() for name, values in self._texts.items()}
        parts["task"] = [self._tasks[number] for number in found["task_index"].tolist()]
        return [dict(zip(parts, values, strict=True)) for values in zip(*parts.values(), strict=True)]


class DecodedSamples(Dataset[dict[str, Any]]):
    """LeRobot's samples by their global indices, pictures included; actions of a chunk after a hold are padding.

    With the number of a draw (`FrameSampler.numbered`) an augmentation depends on it and the seed alone.
    """

    def __init__(self, dataset: LeRobotDataset, lookup: FrameLookup, chunk: Sequence[int], seed: int) -> None:
        self._dataset, self._seed, self._row = dataset, seed, dataset.absolute_to_relative_idx
        self._lookup, self._chunk = lookup, torch.tensor([*chunk])

    def __getitem__(self, drawn: int | tuple[int, int]) -> dict[str, Any]:
        index, number = drawn if isinstance(drawn, tuple) else (drawn, 0)
        with torch.random.fork_rng(devices=()):
            torch.manual_seed(seed_of(self._seed, number, 0, 0))
            found: dict[str, Any] = self._dataset[index if self._row is None else self._row[index]]
        found[f"{ACTION}_is_pad"] |= index + self._chunk >= self._lookup.run_of(index)[1]
        return found
