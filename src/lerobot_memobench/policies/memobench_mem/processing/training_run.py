"""What a training reads: the policy's configuration, its dataset's feature cache and what its prompts say.

It belongs to the policy that is trained, to its processors, and to nobody else in the process: a configuration and a
dataset know their trainings weakly. LeRobot rebuilds a saved pipeline (resume, starting from a checkpoint) without
telling it the dataset or what the configuration has become. So the steps are told as soon as they are rebuilt for a
configuration that is being trained, and follow it: a checkpoint's own settings are those of the run that wrote it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any
from weakref import WeakSet

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.lerobot_hooks import MAKE_PROCESSORS, hooked_for
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.tasks.memory_text import with_memory


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
