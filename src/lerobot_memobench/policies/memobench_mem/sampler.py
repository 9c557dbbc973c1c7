"""What a training reads: which frames LeRobot draws, in which order, and of what their samples are made.

LeRobot is steered by three hooks (`lerobot_hooks`), each for as long as the training lives: the sampler that draws
frames, the reader that makes a sample of one, and the function that makes a policy's processors. All that they need is
a `TrainingRun` of the policy that is trained; nobody else in the process knows it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from lerobot_memobench.datasets.samples import sample
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.lerobot_hooks import DRAW_FRAMES, MAKE_PROCESSORS, READ_SAMPLE, hooked_for
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import PROMPTED, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import ENCODED
from lerobot_memobench.protocol import PROMPT
from lerobot_memobench.tasks.memory_text import with_memory

# -- the run ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """What a policy is about to be trained with.

    Attributes:
        meta: the dataset's metadata, as LeRobot has it.
    """

    config: MemobenchMemConfig
    cache: FrameLookup
    meta: Any

    def __deepcopy__(self, memo: dict[int, Any]) -> TrainingRun:
        """Return itself: the dataset in main memory is not copied with a policy."""
        return self

    @functools.cached_property
    def statistics(self) -> dict[str, dict[str, Any]]:
        """Return the statistics of states and actions by which samples are normalised; none where LeRobot's are.

        They are those of execution frames. Relative actions depend on the chunk, so theirs are the dataset's.

        Raises:
            MemobenchError: actions are relative, and the dataset's statistics are of absolute ones.
        """
        if not isinstance(self.cache, RecordedFrames):
            return {}
        columns = {name: self.cache.columns[name].numpy() for name in (OBS_STATE, ACTION)}
        executed = self.cache.phase != PROMPT
        found = {name: get_feature_stats(one[executed], axis=0, keepdims=False) for name, one in columns.items()}
        if self.config.use_relative_actions:
            found[ACTION] = dict(self.meta.stats[ACTION])
            if np.allclose(found[ACTION]["mean"], columns[ACTION].mean(axis=0), atol=1e-4):
                raise MemobenchError(
                    f"The dataset {self.meta.root} has statistics of absolute actions, and "
                    "--policy.use_relative_actions=true normalises relative ones; recompute them "
                    "(`lerobot-edit-dataset --operation.type=recompute_stats --operation.relative_action=true "
                    f"--operation.chunk_size={self.config.chunk_size}`) or leave use_relative_actions out."
                )
        found[ACTION]["std"] = np.asarray(found[ACTION]["std"]) + STILL
        return found

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
    if isinstance(run.cache, RecordedFrames):
        hooked_for(run, READ_SAMPLE, _reads)
    run.config.drop_n_last_frames = SamplerSpec.of_run(run)  # type: ignore[assignment]  # a number to nobody but LeRobot's sampler


def trainings(of: Any) -> list[TrainingRun]:
    """Return the trainings with a configuration, or on the dataset of some metadata."""
    return [*getattr(of, _LINK, ())]


def training_run(config: Any) -> TrainingRun | None:
    """Return the run that the policy of a configuration is trained in; None where it only acts."""
    return next(iter(trainings(config)), None)


def _follows(make: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap what makes a policy's processors: those of a policy that is trained follow its run.

    Their normalisers get the run's statistics in the place of the dataset's, which LeRobot hands over as such and among
    what replaces settings of saved steps.
    """

    @functools.wraps(make)
    def made(policy_cfg: Any, *args: Any, **named: Any) -> Any:
        run = training_run(policy_cfg)
        if run is not None:
            named = _with_statistics(named, run)
        before, after = make(policy_cfg, *args, **named)
        if run is not None:
            run.follow(before.steps)
        return before, after

    return made


def _with_statistics(given: Any, run: TrainingRun) -> Any:
    """Return arguments in which the statistics of the run stand for those of its dataset."""
    if not isinstance(given, dict):
        return given
    return {
        key: run.statistics[key]
        if key in run.statistics and value is run.meta.stats.get(key)
        else _with_statistics(value, run)
        for key, value in given.items()
    }


def prompt_texts(config: MemobenchMemConfig, meta: Any | None, cache: FrameLookup | None) -> list[str]:
    """Return the dataset's tasks and, with oracle memory, every memory that is put behind them."""
    tasks = [] if meta is None or meta.tasks is None else [str(task) for task in meta.tasks.index]
    if config.oracle_memory and cache is not None:
        tasks += [with_memory("", memory) for memory in cache.memories]
    return tasks


# -- frames that are drawn -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class SamplerSpec:
    """How LeRobot's sampler draws the frames of a training, as the answer to how many it drops at an episode's end.

    lerobot-train draws the frames of all episodes uniformly, each once per epoch, and leaves no say in where an episode
    begins. What it does ask the configuration for is how many frames to drop at the end; this answer is no number, and
    is known to the sampler while it lives. Prompt frames, whose actions have no effect, then take no place in a batch;
    histories still hold them. A sampler that takes it for a number would draw prompts, and is refused.

    Attributes:
        starts: (E,) first frame of each episode that is drawn.
        frames_per_episode: frames of an episode that follow one another.
        tasks: (N,) number of each frame's task; None: each frame is drawn once per epoch.
        weights: (T,) how often each task is drawn, with ``tasks``; an epoch has as many frames as otherwise.
    """

    starts: np.ndarray
    frames_per_episode: int
    tasks: np.ndarray | None = None
    weights: np.ndarray | None = None

    @classmethod
    def of_run(cls, run: TrainingRun) -> SamplerSpec:
        """Return how the frames of a run are drawn by its configuration."""
        cache, weights = run.cache, run.config.task_weights
        starts = execution_starts(cache.episodes, cache.phase)
        if weights is None:
            return cls(starts, run.config.frames_per_episode)
        return cls(starts, run.config.frames_per_episode, *task_weights(run.meta, cache.episodes, cache.phase, weights))

    def __post_init__(self) -> None:
        hooked_for(self, DRAW_FRAMES, _draws)

    @property
    def ordered(self) -> bool:
        """Whether the order is not LeRobot's."""
        return self.frames_per_episode > 1 or self.tasks is not None

    def refuse(self, *_: Any) -> Any:
        """Be no number."""
        raise MemobenchError(
            "What draws the frames of this training is not LeRobot's EpisodeAwareSampler, or something has taken its "
            "place: it knows nothing of execution frames and would draw those of prompts; leave out what replaces it."
        )

    __array_ufunc__ = None  # of an array minus this, numpy asks this
    __lt__ = __le__ = __gt__ = __ge__ = __bool__ = __int__ = __index__ = __float__ = refuse
    __add__ = __radd__ = __sub__ = __rsub__ = __mul__ = __rmul__ = refuse


def execution_starts(episodes: np.ndarray, phase: np.ndarray) -> np.ndarray:
    """Return the first execution frame of each episode (E,); its end where there is none.

    Args:
        episodes: (E + 1,) first frame of each episode, and the number of frames N. phase: (N,) 0 in the prompt.
    """
    return first_frames(episodes[:-1], episodes[1:], np.flatnonzero(phase != PROMPT))


def task_weights(
    meta: Any, episodes: np.ndarray, phase: np.ndarray, weights: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the number (N,) of each frame's task, and the weight (T,) of each task.

    A task is that of our records, which may have several instructions ("twice", "three times"); of another dataset it
    is the episode's instruction.

    Args:
        meta: the dataset's metadata. episodes: (E + 1,) first frame of each episode, and N.
        phase: (N,) 0 in the prompt.
        weights: by task name, memory type or ``prompted``; the first of them that a task has counts, and else 1.

    Raises:
        MemobenchError: a name is none of the dataset's, or no task is left to draw.
    """
    records = [place.record for place in list_episodes(Path(meta.root))]
    said = (" / ".join(tasks) for tasks in meta.episodes["tasks"])
    names = [words if record is None else record.task_name for record, words in zip(records, said, strict=True)]
    tasks, numbers = np.unique(names, return_inverse=True)
    of_frames = np.repeat(numbers, np.diff(episodes))
    types = {name: record.memory_type for name, record in zip(names, records, strict=True) if record is not None}
    prompted = np.bincount(of_frames, phase == PROMPT) > 0
    keys = [
        (str(name), types.get(str(name), ""), PROMPTED * bool(begins))
        for name, begins in zip(tasks, prompted, strict=True)
    ]
    known = sorted({key for row in keys for key in row if key} | {PROMPTED})
    for name in weights:
        if name not in known:
            raise MemobenchError(
                f"policy.task_weights names '{name}', which is no task, memory type or '{PROMPTED}' of the dataset "
                f"{meta.root}; {nearest(name, known)}"
            )
    found = np.array([next((weights[key] for key in row if key in weights), 1.0) for row in keys])
    if not found.any():
        raise MemobenchError(f"policy.task_weights={dict(weights)} leaves no task of {meta.root} to draw.")
    return of_frames, found


def _draws(begin: Callable[..., None]) -> Callable[..., None]:
    """Wrap the beginning of LeRobot's sampler: it draws as its ``drop_n_last_frames`` says, if that says so."""

    @functools.wraps(begin)
    def init(self: Any, *args: Any, **named: Any) -> None:
        asked = dict(zip(DRAW_FRAMES.parameters[1:], args, strict=False)) | named
        spec = asked.get("drop_n_last_frames")
        if isinstance(spec, SamplerSpec):
            asked |= {"drop_n_last_frames": 0, "dataset_from_indices": spec.starts}
            if spec.ordered and type(self).__iter__ is not EpisodeAwareSampler.__iter__:
                spec.refuse()
            self.spec = spec
        begin(self, **asked)
        if isinstance(spec, SamplerSpec) and spec.ordered and self.shuffle:
            self._iter_epoch = functools.partial(_one_epoch, self, spec)

    return init


def _one_epoch(sampler: Any, spec: SamplerSpec, epoch: int, start: int) -> Iterator[int]:
    """Yield the frames of an epoch from its place ``start`` on."""
    chance = sampler._epoch_generator(epoch)
    if spec.tasks is None or spec.weights is None:
        order = grouped_order(sampler._cum_lengths, spec.frames_per_episode, chance)
    else:
        tasks = spec.tasks[sampler._starts]
        order = weighted_order(sampler._cum_lengths, tasks, spec.weights, spec.frames_per_episode, chance)
    return (sampler._frame_index(position) for position in order[start:].tolist())


def grouped_order(ends: np.ndarray, together: int, generator: torch.Generator) -> Tensor:
    """Return all places 0 ... N - 1 in a random order in which ``together`` of an episode follow one another.

    Args:
        ends: (E,) end of each episode's places, counted from the first's beginning; the last is N.
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
    """Return N places at random, ``together`` of an episode in a row: tasks by their weights, in each episodes alike.

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


STILL = 0.01
"""Added to the standard deviations of actions, so that a number that hardly varies is not blown up to noise."""


# -- samples ---------------------------------------------------------------------------------------------------------


def _reads(get_item: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap LeRobot's reader: samples of a dataset on which no policy reads pictures are made out of main memory.

    They hold what this policy reads and no more (`datasets.samples` keeps all but the pictures).
    """

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
    """Refuse changed pictures for a policy that reads features of the dataset's own.

    Raises:
        MemobenchError: they are ``transformed``, and its pictures are encoded ahead.
    """
    if transformed and getattr(policy, "encodes_ahead", False):
        raise MemobenchError(
            "dataset.image_transforms.enable=true would change nothing: this policy's pictures are encoded once, "
            "before training; leave it out (detectors and visual encoders are trained on changed pictures), or use "
            "policy.visual_encoder=random, which encodes the pictures of each sample."
        )


def item(frames: RecordedFrames, meta: Any, deltas: dict[str, list[int]], number: int) -> dict[str, Any]:
    """Return LeRobot's sample of a frame by its global number: its columns, those with deltas at all of their times."""
    episode, _ = frames.locate(number)
    first, end = frames.episodes[episode : episode + 2].tolist()
    columns = {name: column for name, column in frames.columns.items() if not name.startswith(ENCODED)}
    deltas = {name: deltas[name] for name in deltas.keys() & columns.keys()}
    found: dict[str, Any] = dict(sample(columns, number, first, end, deltas))
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
