"""The training run of this process: the policy's configuration, its dataset's memory cache and what its prompts say.

LeRobot rebuilds a saved pipeline (resume, starting from a checkpoint) without telling it the dataset or what the
configuration has become; the policy, which is always told and is always made first, leaves both here. Steps that are
rebuilt follow it: a checkpoint's own settings are those of the run that wrote it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot_memobench.datasets.memory_cache import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.tasks.memory_text import with_memory


@dataclass(frozen=True)
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


_run: TrainingRun | None = None


def begin_training(run: TrainingRun | None) -> None:
    """Called by a policy with the run it is made for; None when it is made to act only."""
    global _run
    _run = run


def training_run() -> TrainingRun | None:
    """Return the run that the policy made last is for; None where it only acts."""
    return _run


def prompt_texts(config: MemobenchMemConfig, meta: Any | None, cache: FrameLookup | None) -> list[str]:
    """Return the dataset's tasks and, with oracle memory, every memory that is put behind them."""
    tasks = [] if meta is None or meta.tasks is None else [str(task) for task in meta.tasks.index]
    if config.oracle_memory and cache is not None:
        tasks += [with_memory("", memory) for memory in cache.memories]
    return tasks


def require_cache(own: FrameLookup | None, run: TrainingRun | None) -> FrameLookup:
    """Return the cache a step was given, or that of the run it was made for, or that of the policy made last.

    Raises:
        MemobenchError: there is none.
    """
    run = run or _run
    cache = own or (run.cache if run is not None else None)
    if cache is None:
        raise MemobenchError(
            "The preprocessor of memobench_mem has no memory cache to look up history in: make the policy with its "
            "dataset_meta first, or give GatherMemoryProcessorStep a cache."
        )
    return cache
