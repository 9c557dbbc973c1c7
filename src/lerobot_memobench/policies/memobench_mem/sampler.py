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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakSet

import numpy as np
import torch
from lerobot.datasets.compute_stats import get_feature_stats
from lerobot.datasets.sampler import EpisodeAwareSampler
from lerobot.utils.constants import ACTION, OBS_STATE
from torch import Tensor

from lerobot_memobench.datasets.execution_frames import first_frames
from lerobot_memobench.datasets.feature_cache.reading import FrameLookup, RecordedFrames
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import DRAW_FRAMES, MAKE_PROCESSORS, READ_SAMPLE, hooked_for
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import SEEN
from lerobot_memobench.protocol import PROMPT
from lerobot_memobench.tasks.memory_text import with_memory


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


# ==== drawn_statistics.py
# Statistics of the frames that are drawn: prompts, in which nothing is done, do not count as actions of zero.

STILL = 0.01
"""Added to the standard deviations of actions, so that a number that hardly varies is not blown up to noise."""


def count_drawn_only(stats: dict[str, dict[str, Any]], frames: RecordedFrames, drawn: np.ndarray) -> None:
    """Replace LeRobot's statistics of states and actions by those of some of the frames (N,) bool, in place.

    They are what LeRobot then hands to every normaliser: a new policy's, and one that goes on from a checkpoint.
    """
    for key in (OBS_STATE, ACTION):
        stats[key] = get_feature_stats(frames.columns[key].numpy()[drawn], axis=0, keepdims=False)
    stats[ACTION]["std"] = stats[ACTION]["std"] + STILL


# ==== training_run.py
# What a training reads: the policy's configuration, its dataset's feature cache and what its prompts say.
#
# It belongs to the policy that is trained, to its processors, and to nobody else in the process: a configuration and a
# dataset know their trainings weakly. LeRobot rebuilds a saved pipeline (resume, starting from a checkpoint) without
# telling it the dataset or what the configuration has become. So the steps are told as soon as they are rebuilt for a
# configuration that is being trained, and follow it: a checkpoint's own settings are those of the run that wrote it.


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """What a policy is about to be trained with.

    Attributes:
        meta: the dataset's metadata, as LeRobot has it.
    """

    config: MemobenchMemConfig
    cache: FrameLookup
    meta: Any

    def prompt_texts(self) -> list[str]:
        """Return every text that prompts are made of."""
        return prompt_texts(self.config, self.meta, self.cache)

    def follow(self, steps: Iterable[Any]) -> None:
        """Hand this to those steps of a preprocessor that ask for it by a method ``follow``."""
        for step in steps:
            if hasattr(step, "follow"):
                step.follow(self)


class _Trainings(WeakSet[TrainingRun]):
    """The trainings of an object as long as they last; no copy of the object has them."""

    def __reduce__(self) -> Any:
        return _Trainings, ()


_LINK = "memobench_trainings"
"""Attribute of a configuration, and of a dataset's metadata."""


def begin_training(run: TrainingRun) -> None:
    """Tell the configuration and the dataset of a run that they are trained with, and on; LeRobot, as it lasts."""
    setattr(run.config, _LINK, _Trainings([run]))
    setattr(run.meta, _LINK, _Trainings([run, *trainings(run.meta)]))
    hooked_for(run, MAKE_PROCESSORS, _follows)


def trainings(of: Any) -> list[TrainingRun]:
    """Return the trainings with a configuration, or on the dataset of some metadata."""
    return [*getattr(of, _LINK, ())]


def training_run(config: Any) -> TrainingRun | None:
    """Return the run that the policy of a configuration is trained in; None where it only acts."""
    return next(iter(trainings(config)), None)


def _follows(make: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap what makes a policy's processors: the steps of a policy that is trained follow its run."""

    @functools.wraps(make)
    def made(policy_cfg: Any, *args: Any, **named: Any) -> Any:
        before, after = make(policy_cfg, *args, **named)
        run = training_run(policy_cfg)
        if run is not None:
            run.follow(before.steps)
        return before, after

    return made


def prompt_texts(config: MemobenchMemConfig, meta: Any | None, cache: FrameLookup | None) -> list[str]:
    """Return the dataset's tasks and, with oracle memory, every memory that is put behind them."""
    tasks = [] if meta is None or meta.tasks is None else [str(task) for task in meta.tasks.index]
    if config.oracle_memory and cache is not None:
        tasks += [with_memory("", memory) for memory in cache.memories]
    return tasks


def require_cache(own: FrameLookup | None, run: TrainingRun | None) -> FrameLookup:
    """Return the cache a step was given, or that of the run it follows.

    Raises:
        MemobenchError: there is none.
    """
    cache = own or (run.cache if run is not None else None)
    if cache is None:
        raise MemobenchError(
            "The preprocessor of memobench_mem has no feature cache to look up history in: make the policy with its "
            "dataset_meta first, and then its processors with that policy's configuration, or give "
            "GatherMemoryProcessorStep a cache."
        )
    return cache


# ==== recorded_items.py
# Training samples out of main memory: what LeRobot would read of a dataset, without pictures and without its disk.
#
# LeRobot's reader decodes the videos of every sample, wanted or not, and takes a millisecond per row for the rest. Where
# the policies that are trained on a dataset object see objects, or what eyes saw before, the dataset's numbers are in
# memory already, and samples are made of these: they hold nothing of a policy's. Every other reader stays as it was.


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
