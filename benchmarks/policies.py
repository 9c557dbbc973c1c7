"""Configurations, random batches and updates of memobench_mem for the benchmarks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import SIZES, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.loop import WeightAverage

MEMORY_FRAMES = 32
"""Frames of a full memory, the default of memory=frames."""


def config(size: str, **fields: Any) -> MemobenchMemConfig:
    """Return a configuration with the features of a generated dataset."""
    side = SIZES[size].vision.image
    image = PolicyFeature(type=FeatureType.VISUAL, shape=(3, side, side))
    return MemobenchMemConfig(
        size=size,
        push_to_hub=False,
        input_features={
            "observation.images.image": image,
            "observation.images.wrist_image": image,
            "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
        },
        output_features={"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))},
        **fields,
    )


def updates(policy: MemobenchMemPolicy, batch: Mapping[str, torch.Tensor]) -> Callable[[], None]:
    """Return a function that makes one update on a batch, as training on a CPU does."""
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    average = WeightAverage(policy.trained_parameters(), policy.config.ema_decay)

    def update() -> None:
        loss, _ = policy.forward(dict(batch))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        average.update()

    return update


def observation(settings: MemobenchMemConfig, rows: int) -> dict[str, torch.Tensor]:
    """Return a random observation as the preprocessor passes it to the policy in a rollout."""
    height, width = settings.image_size
    length = settings.tokenizer_max_length or 0
    return {
        "observation.images.image": torch.rand(rows, 3, height, width),
        "observation.images.wrist_image": torch.rand(rows, 3, height, width),
        "observation.state": torch.rand(rows, 8),
        OBS_LANGUAGE_TOKENS: torch.randint(4, 250, (rows, length)),
        OBS_LANGUAGE_ATTENTION_MASK: torch.arange(length).expand(rows, -1) < min(length, 60),
    }


def training_batch(settings: MemobenchMemConfig, rows: int) -> dict[str, torch.Tensor]:
    """Return a random preprocessed training batch with full histories."""
    dims, frames = settings.dimensions, MEMORY_FRAMES
    return observation(settings, rows) | {
        "action": torch.rand(rows, settings.chunk_size, 7),
        "phase": torch.ones(rows, dtype=torch.int64),
        FRAMES: torch.randn(rows * frames, 16, dims.vlm.width).to(torch.bfloat16),
        STEPS: torch.arange(frames).repeat(rows) * 11,
        PLACES: torch.arange(rows * frames).reshape(rows, frames),
        "memory.text": torch.nn.functional.normalize(torch.randn(rows, dims.text_dim), dim=-1),
        "memory.text_mask": torch.ones(rows, dtype=torch.bool),
    }
