"""Training samples are execution frames: the prompt, whose actions have no effect, takes no place in a batch.

lerobot-train draws the frames of all episodes uniformly, each once per epoch, in an order that seed and epoch decide,
and leaves no say in where an episode begins. What it does ask the configuration for is how many frames to drop at the
end; our answer is none, and carries for its sampler where each episode's execution begins and how many of its frames
follow one another in the order. The sampler is LeRobot's, and any other answer leaves it as it was; a sampler that
takes ours for a number would draw prompts, and is refused. Histories still hold the prompt, because they come from the
feature cache.

Where tasks are balanced, an epoch has as many frames as otherwise, but not each of them once: tasks whose episodes are
short would else be a small part of every batch, and they learned several times slower than the others.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.datasets.sampler import EpisodeAwareSampler
from torch import Tensor

from lerobot_memobench.datasets.execution_frames import first_frames
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import DRAW_FRAMES, hooked_for
from lerobot_memobench.protocol import PROMPT


@dataclass(frozen=True, eq=False)
class Drawn:
    """No frames to drop at the end of each episode, and how the others are drawn by LeRobot's sampler while this lives.

    Attributes:
        starts: from which frame on (E,) to draw.
        moments: how many frames of an episode to draw in a row.
        tasks: (N,) number of each frame's task; None: each frame is drawn once. balance, factors: see `in_turns`.
    """

    starts: np.ndarray
    moments: int
    tasks: np.ndarray | None = None
    balance: float = 1.0
    factors: np.ndarray | None = None

    @classmethod
    def of(cls, *how: Any) -> Drawn:
        """Return one; arguments as of this class."""
        return cls(*how)

    def __post_init__(self) -> None:
        hooked_for(self, DRAW_FRAMES, _draws)

    @property
    def ordered(self) -> bool:
        """Whether the order is ours, too."""
        return self.moments > 1 or self.tasks is not None

    def _refuse(self, *_: Any) -> Any:
        """Be no number."""
        raise MemobenchError(
            "What draws the frames of this training is not LeRobot's EpisodeAwareSampler, or something has taken its "
            "place: it knows nothing of execution frames and would draw those of prompts; leave out what replaces it."
        )

    __array_ufunc__ = None  # of an array minus this, numpy asks this
    __lt__ = __le__ = __gt__ = __ge__ = __bool__ = __int__ = __index__ = __float__ = _refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = _refuse


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


def _draws(begin: Callable[..., None]) -> Callable[..., None]:
    """Wrap the beginning of LeRobot's sampler: it draws as its ``drop_n_last_frames`` says, if that says so."""

    @functools.wraps(begin)
    def init(self: Any, *args: Any, **named: Any) -> None:
        asked = dict(zip(DRAW_FRAMES.parameters[1:], args, strict=False)) | named
        drawn = asked.get("drop_n_last_frames")
        if isinstance(drawn, Drawn):
            asked |= {"drop_n_last_frames": 0, "dataset_from_indices": drawn.starts}
            if drawn.ordered and type(self).__iter__ is not EpisodeAwareSampler.__iter__:
                drawn._refuse()
            self.drawn = drawn
        begin(self, **asked)
        if isinstance(drawn, Drawn) and drawn.ordered and self.shuffle:
            self._iter_epoch = functools.partial(_one_epoch, self, drawn)

    return init


def _one_epoch(sampler: Any, drawn: Drawn, epoch: int, start: int) -> Iterator[int]:
    """Yield the frames of an epoch from its place ``start`` on."""
    chance = sampler._epoch_generator(epoch)
    if drawn.tasks is None:
        order = in_groups(sampler._cum_lengths, drawn.moments, chance)
    else:
        tasks = drawn.tasks[sampler._starts]
        order = in_turns(sampler._cum_lengths, tasks, drawn.moments, chance, drawn.balance, drawn.factors)
    return (sampler._frame_index(position) for position in order[start:].tolist())
