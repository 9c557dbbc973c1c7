"""Training samples out of main memory: what LeRobot would read of a dataset, without pictures and without its disk.

LeRobot's reader decodes the videos of every sample, wanted or not, and takes a millisecond per row for the rest. Where
the policies that are trained on a dataset object see objects, or what eyes saw before, the dataset's numbers are in
memory already, and samples are made of these: they hold nothing of a policy's. Every other reader stays as it was.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.reading import RecordedFrames
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import READ_SAMPLE, hooked_for
from lerobot_memobench.policies.memobench_mem.perception.eyes import SEEN
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun, trainings


def read_from_memory(run: TrainingRun) -> None:
    """Let the dataset that a run is on give samples out of its frames while it lasts."""
    hooked_for(run, READ_SAMPLE, _reads)


def _reads(get_item: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap what makes a sample: of a dataset on which nobody is trained who looks at its pictures, out of memory."""

    @functools.wraps(get_item)
    def read(self: Any, idx: int) -> Any:
        runs = trainings(getattr(self, "trained_with", self._meta))  # a held-out part goes with the one trained on
        if not runs or not all(isinstance(run.cache, RecordedFrames) for run in runs):
            return get_item(self, idx)
        found: dict[str, Any] = {}
        for run in runs:
            assert isinstance(run.cache, RecordedFrames)
            check_transforms(run.config, self._image_transforms is not None)
            found |= item(run.cache, self._meta, self.delta_indices or {}, _number(self, idx))
        return found

    return read


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
    columns = {name: column for name, column in frames.columns.items() if not name.startswith(SEEN)}
    found: dict[str, Any] = {name: column[number] for name, column in columns.items()}
    for name in deltas.keys() & columns.keys():
        wanted = number + torch.tensor(deltas[name])
        found[f"{name}_is_pad"] = (wanted < first) | (wanted >= end)
        found[name] = columns[name][wanted.clamp(first, end - 1)]
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
