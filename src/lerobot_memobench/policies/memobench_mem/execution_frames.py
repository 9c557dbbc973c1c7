"""Training samples are execution frames: the prompt, whose actions have no effect, takes no place in a batch.

lerobot-train draws the frames of all episodes uniformly, each once per epoch, in an order that seed and epoch decide,
and leaves no say in where an episode begins. What it does ask the configuration for is how many frames to drop at the
end; our answer is 0 and carries, for its sampler, where each episode's execution begins and how many of its frames
follow one another in the order. The sampler is LeRobot's, and any other answer leaves it as it was. Histories still
hold the prompt, because they come from the memory cache.

Where tasks are balanced, an epoch has as many frames as otherwise, but not each of them once: tasks whose episodes are
short would else be a small part of every batch, and they learned several times slower than the others.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch import Tensor

from lerobot_memobench.datasets.demonstration import PROMPT
from lerobot_memobench.datasets.execution_frames import first_frames
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes


class Drawn(int):
    """How many frames to drop at the end of each episode, and how the others are drawn.

    Attributes:
        starts: from which frame on (E,) to draw; None: from the first.
        moments: how many frames of an episode to draw in a row.
        tasks: (N,) number of each frame's task; None: each frame is drawn once. balance, factors: see `in_turns`.
    """

    starts: np.ndarray | None
    moments: int
    tasks: np.ndarray | None
    balance: float
    factors: np.ndarray | None

    @classmethod
    def of(
        cls,
        starts: np.ndarray | None,
        moments: int,
        tasks: np.ndarray | None = None,
        balance: float = 1.0,
        factors: np.ndarray | None = None,
    ) -> Drawn:
        """Return 0, which LeRobot's sampler understands from now on."""
        _teach(EpisodeAwareSampler)
        found = cls(0)
        found.starts, found.moments = starts, moments
        found.tasks, found.balance, found.factors = tasks, balance, factors
        return found


def execution_starts(episodes: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the first execution frame of each episode (E,); its end where there is none.

    Args:
        episodes: (E + 1,) first frame of each episode, and the number of frames N. phase: (N,) 0 in the prompt.
    """
    return first_frames(episodes[:-1], episodes[1:], np.flatnonzero(phase != PROMPT))


def task_of_frames(meta: Any, episodes: np.ndarray) -> np.ndarray:
    """Return the number (N,) of each frame's task: of our records' task, else of the episode's instruction.

    A task may have several instructions ("twice", "three times").

    Args:
        episodes: (E + 1,) first frame of each episode, and N.
    """
    said = [" / ".join(tasks) for tasks in meta.episodes["tasks"]]
    records = (place.record for place in list_episodes(Path(meta.root)))
    names = [words if record is None else record.task_name for record, words in zip(records, said, strict=True)]
    numbers = np.unique(names, return_inverse=True)[1]
    return np.repeat(numbers, np.diff(episodes))


def prompted_factors(tasks: np.ndarray, phase: np.ndarray, weight: float) -> np.ndarray:
    """Return (T,) ``weight`` for each task that has a prompt, else 1.

    Args:
        tasks: (N,) number of each frame's task, 0 ... T - 1. phase: (N,) 0 in the prompt.
    """
    return np.where(np.bincount(tasks, phase == PROMPT) > 0, weight, 1.0)


def in_groups(ends: np.ndarray, moments: int, generator: torch.Generator) -> Tensor:
    """Return all places 0 ... N - 1 in a random order in which ``moments`` of an episode follow one another.

    Args:
        ends: (E,) end of each episode's places, counted from the first's beginning; the last is N.
    """
    lengths = torch.from_numpy(np.diff(ends, prepend=0))
    episode = torch.repeat_interleave(lengths)
    mixed = torch.randperm(len(episode), generator=generator)
    mixed = mixed[episode[mixed].argsort(stable=True)]  # within each episode
    rank = torch.arange(len(mixed)) - (lengths.cumsum(0) - lengths)[episode]
    groups = (lengths + moments - 1) // moments
    group = (groups.cumsum(0) - groups)[episode] + rank // moments
    return mixed[torch.randperm(int(groups.sum()), generator=generator)[group].argsort(stable=True)]


def in_turns(
    ends: np.ndarray,
    tasks: np.ndarray,
    moments: int,
    generator: torch.Generator,
    balance: float = 1.0,
    factors: np.ndarray | None = None,
) -> Tensor:
    """Return N places at random, ``moments`` of an episode in a row: a task by ``balance``, in it each episode alike.

    Args:
        ends: (E,) as for `in_groups`. tasks: (E,) number of each episode's task.
        balance: 1: each task equally often; 0: in proportion to its frames; between: to a power of them, 1 - balance,
            as languages are drawn in multilingual models (Conneau et al. 2020, arXiv 1911.02116, section 3.1).
        factors: (T,) how many times as often each task is drawn; None: 1.
    """
    first, count = torch.from_numpy(np.r_[0, ends[:-1]]), int(ends[-1])
    order = torch.from_numpy(np.argsort(tasks, kind="stable"))
    present, number, episodes = np.unique(tasks, return_inverse=True, return_counts=True)
    of_task = torch.from_numpy(episodes)
    groups = -(-count // moments)
    weights = np.bincount(number, np.diff(ends, prepend=0)) ** (1 - balance)
    if factors is not None:
        weights *= factors[present]
    task = torch.multinomial(torch.from_numpy(weights), groups, replacement=True, generator=generator)
    rank = (torch.rand(groups, generator=generator) * of_task[task]).long()
    episode = order[(of_task.cumsum(0) - of_task)[task] + rank].repeat_interleave(moments)
    lengths = torch.from_numpy(ends) - first
    offset = (torch.rand(len(episode), generator=generator, dtype=torch.float64) * lengths[episode]).long()
    return (first[episode] + offset)[:count]


def _teach(sampler: type[Any]) -> None:
    """Let a sampler begin its episodes, and draw them, as its ``drop_n_last_frames`` says, if that says so."""
    original = sampler.__init__
    if hasattr(original, "__wrapped__"):
        return
    signature = inspect.signature(original)

    @functools.wraps(original)
    def init(self: Any, *args: Any, **named: Any) -> None:
        asked = signature.bind(self, *args, **named)
        dropped = asked.arguments.get("drop_n_last_frames", 0)
        self.drawn = dropped if isinstance(dropped, Drawn) else None
        if self.drawn is not None and self.drawn.starts is not None:
            asked.arguments["dataset_from_indices"] = self.drawn.starts
        original(*asked.args, **asked.kwargs)

    one_epoch = sampler._iter_epoch

    def draw(self: Any, epoch: int, start: int) -> Iterator[int]:
        drawn: Drawn | None = self.drawn
        if drawn is None or not self.shuffle or (drawn.moments == 1 and drawn.tasks is None):
            return one_epoch(self, epoch, start)
        chance = self._epoch_generator(epoch)
        if drawn.tasks is None:
            order = in_groups(self._cum_lengths, drawn.moments, chance)
        else:
            tasks = drawn.tasks[self._starts]
            order = in_turns(self._cum_lengths, tasks, drawn.moments, chance, drawn.balance, drawn.factors)
        return (self._frame_index(position) for position in order[start:].tolist())

    sampler.__init__, sampler._iter_epoch = init, draw
