"""pi0.5 with its memory is built, plans and trains: at full size (slow, 24 GiB) and at the tiny size."""

from __future__ import annotations

import dataclasses
import resource
import time

import pytest
import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from lerobot.utils.constants import OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS
from torch import Tensor

from benchmarks.random_weights import fill_buffers, random_policy
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.frames import Frame
from lerobot_memobench.policies.memobench_mem.memory.mechanism import Histories
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation
from lerobot_memobench.policies.memobench_mem.rollout import Row
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
    assert length is not None
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


def _lerobots(policy: MemobenchMemPolicy) -> PI05Pytorch | MemoryPI05:
    """Return LeRobot's model with the policy's weights; a second copy would not fit into memory."""
    config = policy.config
    with torch.device("meta"):
        if config.size == "pi05":
            theirs = PI05Pytorch(PI05Config(device="cpu", dtype="bfloat16", train_expert_only=True))
        else:
            without = {"memory": "none", "memory_fusion": None, "memory_settings": {}, "memory_stride": None}
            theirs = MemoryPI05(dataclasses.replace(config, align="none", **without))  # type: ignore[arg-type]
    own = dict(policy.model.named_parameters())
    for path, module in theirs.named_modules():
        for key, wanted in list(module.named_parameters(recurse=False)):
            ours = own[f"{path}.{key}"]
            assert (ours.dtype, ours.shape) == (wanted.dtype, wanted.shape), f"{path}.{key}"
            setattr(module, key, ours)
    fill_buffers(theirs, torch.device("cpu"))
    return theirs.eval()


def _memory(batch: dict[str, Tensor]) -> Histories:
    return Histories(batch["memory.frames"], batch["memory.steps"], batch["memory.places"])


@torch.no_grad()
def _equals_lerobots(policy: MemobenchMemPolicy, batch: dict[str, Tensor]) -> None:
    theirs = _lerobots(policy)
    actions = torch.nn.functional.pad(batch["action"], (0, policy.config.max_action_dim - 7))
    inputs = {
        "images": [batch[CAMERA] * 2 - 1],
        "img_masks": [torch.ones(1, dtype=torch.bool)],
        "tokens": batch[OBS_LANGUAGE_TOKENS],
        "masks": batch[OBS_LANGUAGE_ATTENTION_MASK],
        "actions": actions,
        "noise": torch.randn(actions.shape),
        "time": torch.full((1,), 0.3),
    }
    assert policy.model.memory is not None
    reading = policy.model.reading(policy.model.memory.replay(_memory(batch)))
    seen = Observation(*(inputs[key] for key in ("images", "img_masks", "tokens", "masks")))
    drawn = [inputs[key] for key in ("actions", "noise", "time")]
    ours = policy.model.forward(seen, *drawn, reading)
    assert torch.isfinite(ours).all()
    assert ours.abs().max() > 0
    expected = theirs.forward(**inputs) if isinstance(theirs, PI05Pytorch) else theirs.forward(seen, *drawn)
    assert torch.equal(ours, expected)


def _plan(policy: MemobenchMemPolicy, batch: dict[str, Tensor]) -> Tensor:
    """Return a plan in the middle of an episode with 32 remembered frames."""
    seen = _memory(batch)
    kept = [Frame(int(step), stored) for step, stored in zip(seen.steps, seen.frames, strict=True)]
    policy.reset()
    policy.rollout.rows = [Row(clock=(1, kept[-1].step), position=kept[-1].step, memory=[kept])]
    keys = (CAMERA, "observation.state", OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK)
    observation = {key: batch[key] for key in keys} | {"observation.step": torch.tensor([[kept[-1].step + 1.0]])}
    planned = policy.predict_action_chunk(observation)
    assert len(policy.rollout.rows[0].memory[0]) == FRAMES + 1
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


def _group(name: str) -> str:
    """Return the part of the model that a parameter belongs to."""
    for part, word in (("modulators", "modulators."), ("expert", ".gemma_expert."), ("memory", "model.memory")):
        if word in name:
            return part
    return "projections of actions and time"


def _peak_gib() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


@pytest.mark.parametrize("size", ["tiny", pytest.param("pi05", marks=pytest.mark.slow)])
def test_policy_equals_pi05_plans_and_trains(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    """One test, so that only one worker holds the policy. Prints seconds and peak memory of each part."""
    started, found = time.perf_counter(), []

    def note(what: str) -> None:
        found.append(f"{what}: {time.perf_counter() - started:.0f} s since the start, peak {_peak_gib():.1f} GiB")

    before = _peak_gib()
    policy = random_policy(_config(size)).eval()
    weights = sum(p.nbytes for p in policy.parameters()) / 2**30
    note(f"{size} built, weights {weights:.1f} GiB")
    assert not any(tensor.is_meta for tensor in (*policy.parameters(), *policy.buffers()))
    assert _peak_gib() < before + 1.1 * weights + 1.0
    batch = _batch(policy.config)
    _equals_lerobots(policy, batch)
    note("forward equals LeRobot's")
    planned = _plan(policy, batch)
    assert planned.shape == (1, CHUNK, 7)
    assert torch.isfinite(planned).all()
    note("planned")
    samples = {name: p.detach().flatten()[:4096].clone() for name, p in policy.named_parameters()}
    modulations = {name for name in samples if ".modulation." in name}
    _step(policy, batch)
    trained = {name: p for name, p in policy.named_parameters() if p.requires_grad}
    note(f"trained {sum(p.numel() for p in trained.values()) / 1e6:.0f} M parameters")
    moved = {
        name
        for name, p in policy.named_parameters()
        if name not in modulations and not torch.equal(p.detach().flatten()[:4096], samples[name].to(p.dtype))
    }
    assert {_group(name) for name in moved} == {_group(name) for name in trained}
    assert moved <= set(trained)
    assert not any("paligemma_with_expert.paligemma." in name for name in trained)
    assert _peak_gib() < MACHINE_GIB
    with capsys.disabled():
        print("\n" + "\n".join(found))
