"""pi0.5 with its memory is built, plans and trains: at full size (slow, 24 GiB) and at the tiny size."""

from __future__ import annotations

import resource

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from benchmarks.random_weights import random_policy
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import RememberedFrame
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.rollout import EnvMemory
from tests.support.small_policy import draw_modulation

CAMERA = "observation.images.image"
FRAMES, PROMPT, CHUNK = 32, 60, 50
MACHINE_GIB = 24


def _config(size: str) -> MemobenchMemConfig:
    """Return a configuration with a frozen VLM in bfloat16."""
    config = MemobenchMemConfig(size=size, device="cpu", push_to_hub=False, dtype="bfloat16", train_expert_only=True)
    side = config.image_size[0]
    config.input_features = {
        CAMERA: PolicyFeature(type=FeatureType.VISUAL, shape=(3, side, side)),
        "observation.state": PolicyFeature(type=FeatureType.STATE, shape=(8,)),
    }
    config.output_features = {"action": PolicyFeature(type=FeatureType.ACTION, shape=(7,))}
    return config


def _batch(config: MemobenchMemConfig) -> dict[str, Tensor]:
    """Return one preprocessed training sample with a full memory."""
    torch.manual_seed(1)
    length = config.tokenizer_max_length
    return {
        CAMERA: torch.rand(1, 3, *config.image_size),
        "observation.state": torch.rand(1, 8),
        OBS_LANGUAGE_TOKENS: torch.randint(4, 250, (1, length)),
        OBS_LANGUAGE_ATTENTION_MASK: torch.arange(length)[None] < min(length, PROMPT),
        "action": torch.rand(1, CHUNK, 7),
        "action_is_pad": torch.zeros(1, CHUNK, dtype=torch.bool),
        "phase": torch.ones(1, dtype=torch.int64),
        "memory.frames": torch.randn(FRAMES, 16, config.dimensions.vlm.width).to(torch.bfloat16),
        "memory.steps": torch.arange(FRAMES) * 11,
        "memory.places": torch.arange(FRAMES)[None],
    }


def _memory(batch: dict[str, Tensor]) -> Histories:
    return Histories(batch["memory.frames"], batch["memory.steps"], batch["memory.places"])


def _plan(policy: MemobenchMemPolicy, batch: dict[str, Tensor]) -> Tensor:
    """Return a plan in the middle of an episode with 32 remembered frames."""
    seen = _memory(batch)
    kept = [RememberedFrame(int(step), stored) for step, stored in zip(seen.steps, seen.frames, strict=True)]
    policy.reset()
    policy.rollout.envs = [EnvMemory(clock=(1, kept[-1].step), position=kept[-1].step, memory=[kept])]
    keys = (CAMERA, "observation.state", OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK)
    observation = {key: batch[key] for key in keys} | {"observation.step": torch.tensor([[kept[-1].step + 1.0]])}
    planned = policy.predict_action_chunk(observation)
    assert len(policy.rollout.envs[0].memory[0]) == FRAMES + 1
    return planned


def _step(policy: MemobenchMemPolicy, batch: dict[str, Tensor]) -> None:
    """Update memory and action expert once, and keep the gradients."""
    draw_modulation(policy, std=0.02)
    policy.train()
    optimizer = policy.config.get_optimizer_preset().build(policy.get_optim_params())
    loss, _ = policy.forward(batch)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(policy.get_optim_params(), 1.0)
    optimizer.step()
    assert torch.isfinite(loss)


def _peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@pytest.mark.parametrize("size", ["tiny", pytest.param("pi05", marks=pytest.mark.slow)])
def test_policy_plans_and_trains(size: str) -> None:
    """One test, so that only one worker holds the policy."""
    before = _peak_gib()
    policy = random_policy(_config(size)).eval()
    weights = sum(p.nbytes for p in policy.parameters()) / 2**30
    assert not any(tensor.is_meta for tensor in (*policy.parameters(), *policy.buffers()))
    assert _peak_gib() < before + 1.1 * weights + 1.0
    batch = _batch(policy.config)
    planned = _plan(policy, batch)
    assert planned.shape == (1, CHUNK, 7)
    assert torch.isfinite(planned).all()
    samples = {name: p.detach().flatten()[:4096].clone() for name, p in policy.named_parameters()}
    _step(policy, batch)
    trained = {name for name, p in policy.named_parameters() if p.requires_grad}
    moved = {
        name
        for name, p in policy.named_parameters()
        if not torch.equal(p.detach().flatten()[:4096], samples[name].to(p.dtype))
    }
    assert moved <= trained
    for part in (".gemma_expert.", "model.memory", "modulators.", "action_out_proj"):
        assert any(part in name for name in moved), part
    assert not any("paligemma_with_expert.paligemma." in name for name in trained)
    assert _peak_gib() < MACHINE_GIB
