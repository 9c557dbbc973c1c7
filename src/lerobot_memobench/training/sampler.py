"""Draw the frames of a training: those whose action has an effect, several of an episode in a row, tasks by weight."""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.constants import PROMPT
from lerobot_memobench.datasets.episodes import list_episodes
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import PROMPTED


class FrameSampler:
    """Yield global indices of frames, in an order that depends on seed and epoch alone.

    Every process draws the same order, and accelerate distributes it. A resumed training draws the rest of its epoch.
    Without groups and weights the order is that of LeRobot's sampler.

    Args:
        episodes: (E + 1,) first frame of each episode, and N. acts: (N,) whether a frame is one to learn from.
        used: the episodes to draw; None: all. together: frames of an episode in a row.
        tasks: result of `task_weights`; None: each frame is drawn once per epoch.
        numbered: whether it yields pairs of a frame and its number among all draws.
    """

    def __init__(
        self,
        episodes: np.ndarray,
        acts: np.ndarray,
        used: Collection[int] | None,
        *,
        together: int = 1,
        tasks: tuple[np.ndarray, np.ndarray] | None = None,
        seed: int = 0,
        numbered: bool = False,
    ) -> None:
        chosen = range(len(episodes) - 1) if used is None else sorted(used)
        parts = [episodes[k] + np.flatnonzero(acts[episodes[k] : episodes[k + 1]]) for k in chosen]
        lengths = np.array([len(part) for part in parts], dtype=np.int64)
        if not lengths.any():
            raise MemobenchError("no episode has an execution frame; name a dataset of `memobench generate`")
        self.frames, self._ends = np.concatenate(parts), np.cumsum(lengths[lengths > 0])
        self._tasks = None if tasks is None else (tasks[0][chosen][lengths > 0], tasks[1])
        self._together, self._seed, self._numbered = together, seed, numbered
        self.epoch = self.offset = 0  # start of the next iteration

    def __len__(self) -> int:
        return len(self.frames)

    def __iter__(self) -> Iterator[Any]:
        order, first = self.order(self.epoch)[self.offset :], self.epoch * len(self) + self.offset
        self.epoch, self.offset = self.epoch + 1, 0
        frames = self.frames[order.numpy()].tolist()
        return zip(frames, itertools.count(first)) if self._numbered else iter(frames)

    def order(self, epoch: int) -> Tensor:
        """Return an epoch's order of the entries of ``frames``."""
        generator = torch.Generator().manual_seed(seed_of(self._seed, epoch, dtype=np.uint64))
        if self._tasks is not None:
            return weighted_order(self._ends, *self._tasks, self._together, generator)
        if self._together > 1:
            return grouped_order(self._ends, self._together, generator)
        return torch.randperm(len(self), generator=generator)

    def resume_from(self, step: int, batch_size: int, processes: int) -> None:
        """Continue after so many updates with a batch size per process."""
        per_epoch = math.ceil(math.ceil(len(self) / batch_size) / processes)  # accelerate pads the last batches
        self.epoch, batches = divmod(step, per_epoch)
        self.offset = min(batches * batch_size * processes, len(self))


def seed_of(*numbers: int, dtype: type[np.uint32 | np.uint64] = np.uint32) -> int:
    """Return a seed that depends on all the numbers."""
    return int(np.random.SeedSequence(numbers).generate_state(1, dtype)[0])


def grouped_order(ends: np.ndarray, together: int, generator: torch.Generator) -> Tensor:
    """Return a random order of 0 ... N - 1 in which ``together`` entries of an episode are in a row.

    ``ends`` (E,) are the ends of the episodes' entries; the last is N.
    """
    lengths = torch.from_numpy(np.diff(ends, prepend=0))
    episode = torch.repeat_interleave(lengths)
    mixed = torch.randperm(len(episode), generator=generator)
    mixed = mixed[episode[mixed].argsort(stable=True)]  # within each episode
    rank = torch.arange(len(mixed)) - (lengths.cumsum(0) - lengths)[episode]
    groups = (lengths + together - 1) // together
    group = (groups.cumsum(0) - groups)[episode] + rank // together
    return mixed[torch.randperm(int(groups.sum()), generator=generator)[group].argsort(stable=True)]


def weighted_order(
    ends: np.ndarray, tasks: np.ndarray, weights: np.ndarray, together: int, generator: torch.Generator
) -> Tensor:
    """Return N random entries, ``together`` of an episode in a row: tasks by weight, episodes of a task equally.

    Args:
        ends: (E,) as for `grouped_order`. tasks: (E,) number of each episode's task. weights: (T,) of the tasks.
    """
    first, count = torch.from_numpy(np.r_[0, ends[:-1]]), int(ends[-1])
    order = torch.from_numpy(np.argsort(tasks, kind="stable"))
    present, episodes = np.unique(tasks, return_counts=True)
    of_task = torch.from_numpy(episodes)
    groups = -(-count // together)
    task = torch.multinomial(torch.from_numpy(weights[present]), groups, replacement=True, generator=generator)
    rank = (torch.rand(groups, generator=generator) * of_task[task]).long()
    episode = order[(of_task.cumsum(0) - of_task)[task] + rank].repeat_interleave(together)
    lengths = torch.from_numpy(ends) - first
    offset = (torch.rand(len(episode), generator=generator, dtype=torch.float64) * lengths[episode]).long()
    return (first[episode] + offset)[:count]


def task_weights(
    meta: Any, episodes: np.ndarray, phase: np.ndarray, weights: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (E,) of each episode's task, and the weight (T,) of each task.

    A task of the benchmark may have several instructions ("twice", "three times"). In other datasets each instruction
    is a task.

    Args:
        episodes: (E + 1,) first frame of each episode, and N. phase: (N,) 0 in the prompt.
        weights: by task name, memory type or ``prompted``; the first match in this order counts, the default is 1.
    """
    records = [episode.record for episode in list_episodes(Path(meta.root))]
    texts = (" / ".join(tasks) for tasks in meta.episodes["tasks"])
    names = [text if record is None else record.task_name for record, text in zip(records, texts, strict=True)]
    tasks, numbers = np.unique(names, return_inverse=True)
    types = {name: record.memory_type for name, record in zip(names, records, strict=True) if record is not None}
    prompted = np.bincount(np.repeat(numbers, np.diff(episodes)), phase == PROMPT) > 0
    with_prompt = [PROMPTED if begins else "" for begins in prompted]
    keys = [(name, types.get(name, ""), word) for name, word in zip(tasks.tolist(), with_prompt, strict=True)]
    known = sorted({key for row in keys for key in row if key} | {PROMPTED})
    for name in weights:
        if name not in known:
            raise MemobenchError(
                f"policy.task_weights names '{name}'; expected a task or memory type of the dataset {meta.root}, or "
                f"'{PROMPTED}'; {nearest(name, known)}"
            )
    by_task = np.array([next((weights[key] for key in row if key in weights), 1.0) for row in keys])
    if not by_task.any():
        raise MemobenchError(
            f"policy.task_weights={dict(weights)} gives every task of {meta.root} the weight 0; set one above 0"
        )
    return numbers, by_task
