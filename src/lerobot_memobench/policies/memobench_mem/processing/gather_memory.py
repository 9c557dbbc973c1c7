"""Memory, phase and subgoals of training samples, looked up in the feature cache.

LeRobot keeps of a training batch only what its transition knows, and that is the frame's global ``index``; phase,
subgoals and history are therefore all looked up by it. Rollouts carry no ``index``; there the policy itself keeps the
history.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.processor import ProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_ENV_STATE
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup, RecordedFrames
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.batch import FRAMES, MASK, PHASE, STEPS, TOKENS, collate_frames
from lerobot_memobench.policies.memobench_mem.memory.frame_sampling import FrameSampling
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism
from lerobot_memobench.policies.memobench_mem.memory.none import NoMemory
from lerobot_memobench.policies.memobench_mem.memory.registry import make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.training import recall_at
from lerobot_memobench.policies.memobench_mem.perception.eyes import SEEN
from lerobot_memobench.policies.memobench_mem.processing.subgoals import (
    text_rows,
    texts_of_frames,
    texts_of_histories,
)
from lerobot_memobench.policies.memobench_mem.processing.training_run import TrainingRun, require_cache


def gathering(config: MemobenchMemConfig) -> dict[str, Any]:
    """Return the fields of a policy's `GatherMemoryProcessorStep`."""
    same = ("align", "subgoal_level", "shuffle_subgoals", "shuffle_seed", "memory")
    frames = make_mechanism(config.memory, config.memory_frames).frames
    return {"frames": frames} | {name: getattr(config, name) for name in same}


@dataclass
@ProcessorStepRegistry.register(name="memobench_gather_memory")
class GatherMemoryProcessorStep(ProcessorStep):
    """Add history, phase and subgoal embeddings to training samples; leave observations of a rollout alone.

    Adds ``memory.tokens`` (B, F, P, D), ``memory.steps`` (B, F) int64, ``memory.mask`` (B, F) bool, ``phase`` (B,),
    what eyes saw in the frames (``observation.seen.*``), and with an alignment ``memory.text`` and
    ``memory.text_mask``: (B, d_t) and (B,) for the frame itself, or with ``framewise`` (B, F, d_t) and (B, F) for the
    frames of the history. With ``frames`` 0 (``integration=none``) there is no history.

    A step that is rebuilt from a checkpoint has the settings of the run that wrote it, until it is told to ``follow``
    another one. One that is given a ``cache`` keeps its own.
    """

    frames: int = 32
    align: str = "none"
    subgoal_level: str = "intermediate"
    shuffle_subgoals: bool = False
    shuffle_seed: int = 7
    memory: str = FrameSampling.name
    cache: FrameLookup | None = field(default=None, repr=False)
    _run: TrainingRun | None = field(default=None, init=False, repr=False)
    _texts: np.ndarray | None = field(default=None, init=False, repr=False)

    def follow(self, run: TrainingRun) -> None:
        """Look up in a run's cache from now on, by its settings, unless there is a cache of its own."""
        if self.cache is not None:
            return
        self._run, self._texts = run, None
        for name, value in gathering(run.config).items():
            setattr(self, name, value)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        """Return the transition with what was looked up."""
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if "index" not in extra or transition.get(TransitionKey.ACTION) is None:
            return transition
        cache = require_cache(self.cache, self._run)
        indices = extra["index"].reshape(-1).tolist()
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, **self.gather(cache, indices)}
        told = transition.get(TransitionKey.OBSERVATION) or {}
        # LeRobot passes on observations alone, and in a dataset with pictures objects are none by name.
        if isinstance(cache, RecordedFrames) and OBS_ENV_STATE in cache.columns and OBS_ENV_STATE not in told:
            transition[TransitionKey.OBSERVATION] = {**told, OBS_ENV_STATE: cache.columns[OBS_ENV_STATE][indices]}
        return transition

    @property
    def mechanism(self) -> MemoryMechanism:
        """How samples remember; with no frames, not at all."""
        return make_mechanism(self.memory if self.frames else NoMemory.name, self.frames)

    def gather(self, cache: FrameLookup, indices: Sequence[int]) -> dict[str, Tensor]:
        """Look up frames of the dataset by their global indices."""
        places = [cache.locate(index) for index in indices]  # refuses frames that the cache does not know
        phase = {PHASE: torch.from_numpy(cache.phase[np.asarray(indices)].astype(np.int64))}
        if isinstance(cache, RecordedFrames):
            seen = [name for name in cache.columns if name.startswith(SEEN)]
            phase |= {name: cache.columns[name][torch.tensor(indices)] for name in seen}
        mechanism = self.mechanism
        if mechanism.frames == 0:
            return phase
        recalled = [recall_at(cache, mechanism, episode, frame) for episode, frame in places]
        memory = dict(zip((TOKENS, STEPS, MASK), collate_frames(recalled, mechanism.frames), strict=True))
        if isinstance(cache, RecordedFrames):  # what is encoded for every batch anew is encoded once in it
            starts = torch.from_numpy(cache.episodes)[[episode for episode, _ in places]]
            memory[FRAMES] = (memory[STEPS] + starts[:, None]).masked_fill(~memory[MASK], -1)
        if self.align == "none":
            return memory | phase
        rows = self._text_rows(cache)
        if self.align != "framewise":
            return memory | phase | texts_of_frames(cache, rows, indices)
        histories = [
            int(cache.episodes[episode]) + np.array([frame.step for frame in frames])
            for (episode, _), frames in zip(places, recalled, strict=True)
        ]
        return memory | phase | texts_of_histories(cache, rows, histories, mechanism.frames)

    def _text_rows(self, cache: FrameLookup) -> np.ndarray:
        if self._texts is None:
            seed = self.shuffle_seed if self.shuffle_subgoals else None
            self._texts = text_rows(cache, self.subgoal_level, self.align, seed)
        return self._texts

    def get_config(self) -> dict[str, Any]:
        """Return what the processor file holds; ``frames`` alone tells the oldest two mechanisms apart there."""
        found = {
            "frames": self.frames,
            "align": self.align,
            "subgoal_level": self.subgoal_level,
            "shuffle_subgoals": self.shuffle_subgoals,
            "shuffle_seed": self.shuffle_seed,
        }
        return found if self.memory in (FrameSampling.name, NoMemory.name) else found | {"memory": self.memory}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features
