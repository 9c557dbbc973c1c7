"""Samples of a LeRobot dataset out of main memory, for policies that read no pictures.

LeRobot decodes the videos of every sample, wanted or not, and reads a row of a table for every time that a sample asks
for. Here numbers lie in tensors, and pictures are left out; the rest of a sample is LeRobot's, bit for bit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from torch import Tensor


def sample(
    columns: Mapping[str, Tensor], row: int, first: int, end: int, deltas: Mapping[str, Sequence[int]]
) -> dict[str, Tensor]:
    """Return the numbers of a row, those with deltas at all of their times, as LeRobot does.

    Args:
        columns: name -> numbers (N, ...). first, end: rows of its episode. deltas: name -> rows from this one.
    """
    found = {name: column[row] for name, column in columns.items()}
    for name, steps in deltas.items():
        wanted = row + torch.tensor(steps)
        found[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
        if name in columns:
            found[name] = columns[name][wanted.clamp(first, end - 1)]
    return found


def keep_in_memory(dataset: Any) -> None:
    """Give the samples of an opened dataset out of main memory, without pictures."""
    dataset.reader.get_item = _Rows(dataset.reader).sample


class _Rows:
    """The rows of LeRobot's reader: numbers as tensors of the types that LeRobot makes of them, the rest as a table."""

    def __init__(self, reader: Any) -> None:
        meta, dataset = reader._meta, reader.hf_dataset
        self.deltas, self.tasks = reader.delta_indices or {}, meta.tasks.index.tolist()
        self.bounds = np.array([meta.episodes["dataset_from_index"], meta.episodes["dataset_to_index"]])
        shown = [name for name in dataset.column_names if name not in meta.camera_keys]
        like = dataset.select_columns(shown)[0]
        table: pa.Table = dataset.select_columns(shown).with_format("arrow")[:]
        numbers = [name for name in shown if isinstance(like[name], Tensor)]
        self.columns = {name: _numbers(table.column(name), like[name]) for name in numbers}
        self.rest = table.drop_columns(numbers).combine_chunks()

    def sample(self, row: int) -> dict[str, Any]:
        """Return LeRobot's sample of a row, without pictures."""
        number, episode = int(self.columns["index"][row]), int(self.columns["episode_index"][row])
        first, end = (self.bounds[:, episode] - number + row).tolist()  # a reader may hold some episodes only
        found: dict[str, Any] = dict(sample(self.columns, row, first, end, self.deltas))
        found |= {name: self.rest.column(name)[row].as_py() for name in self.rest.column_names}
        return found | {"task": self.tasks[int(found["task_index"])]}


def _numbers(column: pa.ChunkedArray, like: Tensor) -> Tensor:
    """Return a column as LeRobot's transform makes it, row by row: ``like`` is its first."""
    flat: Any = column.combine_chunks()
    while isinstance(flat, pa.ExtensionArray | pa.ListArray | pa.LargeListArray | pa.FixedSizeListArray):
        flat = flat.storage if isinstance(flat, pa.ExtensionArray) else flat.flatten()
    numbers = torch.from_numpy(flat.to_numpy(zero_copy_only=False).copy())
    return numbers.to(like.dtype).reshape(len(column), *like.shape)
