"""Policies and batches for the benchmarks of memobench_mem: with a memory, and plain pi0.5, of the same dimensions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import (
    SIZES,
    Gemma,
    MemobenchMemConfig,
    Vision,
)
from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.average import WeightAverage
from lerobot_memobench.training.speed import quick_products

# A size between tiny and pi05 that a CPU can train, with the full size's proportions: 256 patches per image, a VLM
# that is wider than its expert, a chunk of 50, memory of 512 tokens.
SIZES.setdefault(
    "middle",
    replace(
        SIZES["tiny"],
        vlm=Gemma(width=512, depth=4, mlp_dim=2048, num_heads=8, num_kv_heads=1, head_dim=64),
        expert=Gemma(width=256, depth=4, mlp_dim=1024, num_heads=8, num_kv_heads=1, head_dim=64),
        vision=Vision(width=288, depth=4, mlp_dim=1076, num_heads=8, patch=14, image=224),
        tokenizer_max_length=200,
    ),
)


def config(size: str, **fields: Any) -> MemobenchMemConfig:
    """A configuration with the dataset's features."""
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
    """Return a function that makes one update of a policy on a batch, as training does, and waits for its end."""
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    there = {key: value.to(policy.config.device) for key, value in batch.items()}
    average = WeightAverage(policy.trained_parameters(), policy.config.ema_decay)
    on_cpu = policy.config.device == "cpu" and not policy.config.uses_visual_encoder

    def update() -> None:
        with quick_products() if on_cpu else nullcontext():
            loss, _ = policy.forward(there)
            loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()
        average.update()
        if policy.config.device != "cpu":
            torch.cuda.synchronize()

    return update


def observation(settings: MemobenchMemConfig, rows: int) -> dict[str, torch.Tensor]:
    """What the preprocessor hands to the policy in a rollout."""
    height, width = settings.image_size
    assert settings.tokenizer_max_length is not None
    length = settings.tokenizer_max_length
    tokens = torch.randint(4, 250, (rows, length))
    return {
        "observation.images.image": torch.rand(rows, 3, height, width),
        "observation.images.wrist_image": torch.rand(rows, 3, height, width),
        "observation.state": torch.rand(rows, 8),
        OBS_LANGUAGE_TOKENS: tokens,
        OBS_LANGUAGE_ATTENTION_MASK: torch.arange(length).expand(rows, -1) < min(length, 60),
    }


def remembered(rows: int, moments: int, frames: int, kept: int) -> torch.Tensor:
    """Numbers (rows, frames) of the frames that some moments of each episode read, of ``kept`` ones; -1 where none."""
    numbers = torch.full((rows, frames), -1)
    for row in range(rows):
        read = torch.tensor(sample_frames(int(torch.randint(kept // 3, kept, ())), frames))
        numbers[row, : len(read)] = row // moments * kept + read
    return numbers


def histories(numbers: torch.Tensor, stored: torch.Tensor, kept: int, stride: int) -> dict[str, torch.Tensor]:
    """Return for a batch the frames of ``stored`` by their ``numbers`` (rows, frames), each once; -1 where none."""
    unique, places = numbers.unique(return_inverse=True)
    begins = int(unique[0] < 0)
    there = unique[begins:]
    return {FRAMES: stored[there], STEPS: there % kept * stride, PLACES: places - begins}


def training_batch(settings: MemobenchMemConfig, rows: int) -> dict[str, torch.Tensor]:
    """A preprocessed training batch with full histories."""
    dims, frames = settings.dimensions, settings.memory_settings.get("frames", 0)
    return observation(settings, rows) | {
        "action": torch.rand(rows, settings.chunk_size, 7),
        "phase": torch.ones(rows, dtype=torch.int64),
        FRAMES: torch.randn(rows * frames, 16, dims.vlm.width).to(torch.bfloat16),
        STEPS: torch.arange(frames).repeat(rows) * 11,
        PLACES: torch.arange(rows * frames).reshape(rows, frames),
        "memory.text": torch.nn.functional.normalize(torch.randn(rows, dims.text_dim), dim=-1),
        "memory.text_mask": torch.ones(rows, dtype=torch.bool),
    }
