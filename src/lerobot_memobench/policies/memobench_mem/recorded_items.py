"""Training samples out of main memory: what LeRobot would read of a dataset, without pictures and without its disk.

LeRobot's reader decodes the videos of every sample, wanted or not, and takes a millisecond per row for the rest. Where
the policy that is about to be trained sees objects, its frames are in memory already, and samples are made of these;
where it has eyes, what they saw stands in the place of pictures. Every other reader stays as it was.
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.dataset_reader import DatasetReader
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import RecordedFrames
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.processing.training_run import training_run


def read_from_memory() -> None:
    """Let LeRobot's datasets give samples out of the frames of this process's training run, where they are its own."""
    original = DatasetReader.get_item
    if hasattr(original, "__wrapped__"):
        return

    @functools.wraps(original)
    def get_item(self: Any, idx: int) -> dict[str, Any]:
        run = training_run()
        if run is None or not isinstance(run.cache, RecordedFrames) or Path(self.root) != Path(run.meta.root):
            return original(self, idx)
        check_transforms(run.config, self._image_transforms is not None)
        return item(run.cache, run.meta, self.delta_indices or {}, _number(self, idx))

    DatasetReader.get_item = get_item


def check_transforms(policy: Any, transformed: bool) -> None:
    """Refuse changed pictures for a policy whose samples are made of what was seen in them before.

    Raises:
        MemobenchError: they are ``transformed``, and it has eyes.
    """
    if transformed and getattr(policy, "has_eyes", False):
        raise MemobenchError(
            "dataset.image_transforms.enable=true would change nothing: a policy with eyes learns from what was once "
            "seen in the dataset's pictures; leave it out (eyes are trained on changed pictures), or use "
            "policy.eyes=random, which looks at the pictures of each sample."
        )


def item(frames: RecordedFrames, meta: Any, deltas: dict[str, list[int]], number: int) -> dict[str, Any]:
    """Return LeRobot's sample of a frame by its global number: its columns, those with deltas at all of their times."""
    episode, _ = frames.locate(number)
    first, end = frames.episodes[episode : episode + 2].tolist()
    found: dict[str, Any] = {name: column[number] for name, column in frames.columns.items()}
    for name in deltas.keys() & frames.columns.keys():
        wanted = number + torch.tensor(deltas[name])
        found[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
        found[name] = frames.columns[name][wanted.clamp(first, end - 1)]
    found["task"] = meta.tasks.index[int(found["task_index"])]
    return found


def _number(reader: Any, row: int) -> int:
    """Return the global number of a row of a reader, which may hold some episodes only."""
    if reader._absolute_to_relative_idx is None:
        return row
    if getattr(reader, "numbers_of_rows", None) is None:
        reader.numbers_of_rows = torch.tensor(list(reader._absolute_to_relative_idx))
    rows: Tensor = reader.numbers_of_rows
    return int(rows[row])
