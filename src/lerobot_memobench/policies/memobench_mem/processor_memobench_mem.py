"""Pre- and post-processing of ``memobench_mem``: pi0.5's steps, plus the history that training samples look back on.

LeRobot keeps of a training batch only what its transition knows, and that is the frame's global ``index``; phase,
subgoals and history are therefore all looked up by it in the memory cache. Rollouts carry no ``index``; there the
policy itself keeps the history.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.lerobot_types import EnvTransition, TransitionKey
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from lerobot.processor import (
    AbsoluteActionsProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    ProcessorStep,
    ProcessorStepRegistry,
    RelativeActionsProcessorStep,
    TokenizerProcessorStep,
    make_default_policy_processor_steps,
    make_policy_processor_pipelines,
)
from torch import Tensor

from lerobot_memobench.datasets.memory_cache import MemoryCache
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import collate_frames, sample_frames
from lerobot_memobench.policies.memobench_mem.text import WordTokenizerProcessorStep, make_vocabulary
from lerobot_memobench.tasks.memory_text import MARK, with_memory

TOKENS, STEPS, MASK = "memory.tokens", "memory.steps", "memory.mask"
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"

# LeRobot rebuilds a saved pipeline (resume, fine-tuning) without telling it the dataset; the policy, which is always
# told and is always made first, leaves its checked cache here.
_training_cache: MemoryCache | None = None


def set_training_cache(cache: MemoryCache | None) -> None:
    """Called by the policy with the cache of the dataset it is about to train on."""
    global _training_cache
    _training_cache = cache


def _cache(own: MemoryCache | None) -> MemoryCache:
    """The cache a step was given, or else that of the dataset being trained on."""
    cache = own or _training_cache
    if cache is None:
        raise MemobenchError(
            "The preprocessor of memobench_mem has no memory cache to look up history in: make the policy with its "
            "dataset_meta first, or give GatherMemoryProcessorStep a cache."
        )
    return cache


@dataclass
@ProcessorStepRegistry.register(name="memobench_gather_memory")
class GatherMemoryProcessorStep(ProcessorStep):
    """Add history, phase and subgoal embeddings to training samples; leave observations of a rollout alone.

    Adds ``memory.tokens`` (B, F, P, D) bfloat16, ``memory.steps`` (B, F) int64, ``memory.mask`` (B, F) bool, ``phase``
    (B,), and with an alignment ``memory.text`` and ``memory.text_mask``: (B, d_t) and (B,) for the frame itself, or
    with ``framewise`` (B, F, d_t) and (B, F) for the frames of the history. With ``frames`` 0 (``integration=none``)
    there is no history, and only ``phase`` is added.
    """

    frames: int = 32
    align: str = "none"
    subgoal_level: str = "intermediate"
    shuffle_subgoals: bool = False
    shuffle_seed: int = 7
    cache: MemoryCache | None = field(default=None, repr=False)
    _texts: np.ndarray | None = field(default=None, init=False, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        if "index" not in extra or transition.get(TransitionKey.ACTION) is None:
            return transition
        cache = _cache(self.cache)
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {
            **extra,
            **self.gather(cache, extra["index"].reshape(-1).tolist()),
        }
        return transition

    def gather(self, cache: MemoryCache, indices: Sequence[int]) -> dict[str, Tensor]:
        """Look up frames of the dataset by their global indices."""
        places = [cache.locate(index) for index in indices]  # refuses frames that the cache does not know
        phase = torch.from_numpy(cache.phase[np.asarray(indices)].astype(np.int64))
        if self.frames == 0:
            return {PHASE: phase}
        stride = cache.meta.stride
        rows, history = [], []
        for episode, frame in places:
            slots = sample_frames(frame // stride, self.frames)
            steps = [slot * stride for slot in slots]
            rows.append((list(cache.tokens(episode, slots)), steps))
            history.append(int(cache.episodes[episode]) + np.asarray(steps))
        tokens, steps_tensor, mask = collate_frames(rows, self.frames)
        found = {
            TOKENS: tokens,
            STEPS: steps_tensor,
            MASK: mask,
            PHASE: phase,
        }
        if self.align == "none":
            return found
        numbers = self._text_rows(cache)
        if self.align == "framewise":
            text_rows = np.full((len(indices), self.frames), -1, dtype=np.int64)
            for row, frames in enumerate(history):
                text_rows[row, : len(frames)] = numbers[frames]
        else:
            text_rows = numbers[np.asarray(indices)].astype(np.int64)
        row_tensor = torch.from_numpy(text_rows)
        found[TEXT_MASK] = row_tensor >= 0
        found[TEXT] = cache.text_embeddings[row_tensor.clamp(min=0)]
        return found

    def _text_rows(self, cache: MemoryCache) -> np.ndarray:
        if self._texts is None:
            self._texts = cache.text_rows(self.subgoal_level)
            if len(cache.texts) == 0:
                raise MemobenchError(
                    f"The dataset of {cache.folder} has no subgoal text, so --policy.align={self.align} has nothing to "
                    "align to; use --policy.align=none, or a dataset with subgoals."
                )
            if self.shuffle_subgoals:
                self._texts = shuffle_within_episodes(self._texts, cache.episodes, self.shuffle_seed)
        return self._texts

    def get_config(self) -> dict[str, Any]:
        return {
            "frames": self.frames,
            "align": self.align,
            "subgoal_level": self.subgoal_level,
            "shuffle_subgoals": self.shuffle_subgoals,
            "shuffle_seed": self.shuffle_seed,
        }

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


@dataclass
@ProcessorStepRegistry.register(name="memobench_oracle_memory")
class OracleMemoryProcessorStep(ProcessorStep):
    """The paper's control: ground-truth memory text behind the instruction, before the prompt is tokenized.

    Training samples take it from the dataset's column ``memory``. In a rollout the environment, which alone knows what
    has been done, writes the same words into its instruction; one that does not is refused, because the policy would
    be scored without the memory it was trained on.
    """

    cache: MemoryCache | None = field(default=None, repr=False)

    def __call__(self, transition: EnvTransition) -> EnvTransition:
        extra = transition.get(TransitionKey.COMPLEMENTARY_DATA) or {}
        tasks = extra.get("task") or []
        if "index" in extra and transition.get(TransitionKey.ACTION) is not None:
            memories = _cache(self.cache).memory_texts(extra["index"].reshape(-1).tolist())
            tasks = [with_memory(task, memory) for task, memory in zip(tasks, memories, strict=True)]
        elif not tasks or not all(MARK in task for task in tasks):
            raise MemobenchError(
                "This policy was trained with oracle_memory=true and the environment gives no memory text; evaluate it "
                "with --env.oracle_memory=true."
            )
        transition = transition.copy()
        transition[TransitionKey.COMPLEMENTARY_DATA] = {**extra, "task": tasks}
        return transition

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        return features


def shuffle_within_episodes(rows: np.ndarray, episodes: np.ndarray, seed: int = 7) -> np.ndarray:
    """The paper's control: the subgoals of each episode change places, each keeping its number of frames or not.

    Args:
        rows: (N,) text number per frame, -1 for none. episodes: (E + 1,) first frame of each episode.
        seed: which shuffle.

    Returns:
        (N,) text numbers. Every subgoal of an episode with several is replaced by another one of the same episode; the
        same in every run with this seed.
    """
    shuffled = rows.copy()
    for episode, (start, end) in enumerate(itertools.pairwise(episodes)):
        present = np.unique(rows[start:end])
        present = present[present >= 0]
        # A rotation of a random order moves every subgoal; a plain permutation could leave them where they were.
        order = np.random.default_rng([seed, episode]).permutation(present)
        replace = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))
        shuffled[start:end] = [replace.get(row, -1) for row in rows[start:end].tolist()]
    return shuffled


def make_memobench_mem_pre_post_processors(
    config: MemobenchMemConfig,
    dataset_stats: dict[str, dict[str, Any]] | None = None,
    dataset_meta: Any | None = None,
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Build both processors of a new policy (LeRobot's factory calls this when nothing saved is loaded).

    Args:
        dataset_stats: normalisation statistics of the training dataset.
        dataset_meta: its metadata, whose task texts become the tiny tokenizer's words. LeRobot 0.6.1 leaves it on the
            config instead.

    Raises:
        MemobenchError: no statistics, as when a policy is evaluated that was never trained.
    """
    if not dataset_stats:
        raise MemobenchError(
            "memobench_mem was given no dataset statistics, so states and actions could not be normalised and every "
            "episode would fail: evaluate a trained checkpoint with --policy.path=<folder of pretrained_model>."
        )
    meta = dataset_meta or getattr(config, "_runtime_dataset_meta", None)
    steps = make_default_policy_processor_steps(config, dataset_stats)
    relative = RelativeActionsProcessorStep(
        enabled=config.use_relative_actions,
        exclude_joints=config.relative_exclude_joints,
        action_names=config.action_feature_names,
    )
    input_steps: list[ProcessorStep] = [
        steps.rename_observations,
        steps.add_batch_dim,
        GatherMemoryProcessorStep(
            frames=0 if config.integration == "none" else config.memory_frames,
            align=config.align,
            subgoal_level=config.subgoal_level,
            shuffle_subgoals=config.shuffle_subgoals,
            shuffle_seed=config.shuffle_seed,
        ),
        *([OracleMemoryProcessorStep()] if config.oracle_memory else []),
        relative,
        steps.normalize,  # before the prompt, which spells the normalised state out
        Pi05PrepareStateTokenizerProcessorStep(max_state_dim=config.max_state_dim),
        _tokenizer(config, meta),
        steps.to_device,
    ]
    output_steps: list[ProcessorStep] = [
        steps.unnormalize,
        AbsoluteActionsProcessorStep(enabled=config.use_relative_actions, relative_step=relative),
        steps.to_cpu,
    ]
    return make_policy_processor_pipelines(input_steps=input_steps, output_steps=output_steps)


def _tokenizer(config: MemobenchMemConfig, meta: Any | None) -> TokenizerProcessorStep:
    options = {"max_length": config.tokenizer_max_length, "padding_side": "right", "padding": "max_length"}
    if config.tokenizer_name != "words":
        try:
            return TokenizerProcessorStep(tokenizer_name=config.tokenizer_name, **options)
        except OSError as error:
            raise MemobenchError(
                f"The tokenizer '{config.tokenizer_name}' could not be loaded: give a folder that holds PaliGemma's "
                "tokenizer by --policy.tokenizer_name, or log in to the hub, where it is gated."
            ) from error
    tasks = [] if meta is None or meta.tasks is None else [str(task) for task in meta.tasks.index]
    if config.oracle_memory and _training_cache is not None:
        tasks += [with_memory("", memory) for memory in _training_cache.memories]
    return WordTokenizerProcessorStep(vocabulary=make_vocabulary(tasks, config.dimensions.vocabulary), **options)
