"""The network: equality with LeRobot's pi0.5, modulation by memory, the image tower."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.fusion import (
    MemoryModulator,
    MemoryPass,
    ModulationPass,
    Prefix,
    rms_norm,
    rotate_from,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation, adaptive_norms
from lerobot_memobench.policies.memobench_mem.objects import HAND_DIM
from lerobot_memobench.sim.object_layout import SIZE, SLOTS, WIDTH
from tests.support.small_policy import draw_modulation, histories, small_config


class Passes(PI05Pytorch):
    """pi0.5 as LeRobot computes it, with the tokens and conditions that a memory adds."""

    def __init__(self, ours: MemoryPI05, memory: MemoryTokens | None) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(vars(ours))
        own = {name: getattr(ours.config, name) for name in ("chunk_size", "max_action_dim", "num_inference_steps")}
        self.config = PI05Config(device="cpu", n_action_steps=1, **own)
        self.rtc_processor, self.gradient_checkpointing_enabled = None, False
        self._ours, self._memory = [ours], memory
        self.memory_pass: MemoryPass = MemoryPass()
        self.seen: Prefix | None = None

    def embed_prefix(self, *observed: Any) -> tuple[Tensor, Tensor, Tensor]:
        self.memory_pass = self._ours[0].memory_pass(self._memory)
        prefix = self.seen = self._ours[0].embed(Observation(*observed), self.memory_pass)
        return prefix.tokens, prefix.real, torch.zeros_like(prefix.real)

    def embed_suffix(self, noisy_actions: Tensor, timestep: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        tokens, _, blocks, condition = super().embed_suffix(noisy_actions, timestep)
        assert self.seen is not None
        if self.seen.instruction is not None:
            condition = condition + self.seen.instruction
        tokens, condition = self.memory_pass.actions(tokens), self.memory_pass.condition(condition)
        real = torch.ones(tokens.shape[:2], dtype=torch.bool)
        blocks = torch.cat([blocks, torch.zeros_like(real).to(blocks)], dim=1)
        return tokens, real, blocks[:, : real.shape[1]], condition


class Norm(nn.Module):
    """LeRobot's norm before a feed-forward, and the memory's modulation after it."""

    def __init__(self, norm: nn.Module, modulator: MemoryModulator, passes: Passes) -> None:
        super().__init__()
        self.norm, self.modulators, self.passes = norm, [modulator], [passes]  # lists are not registered

    def forward(self, x: Tensor, cond: Tensor) -> tuple[Tensor, Tensor]:
        normed, gate = self.norm(x, cond=cond)
        memory_pass = self.passes[0].memory_pass
        assert isinstance(memory_pass, ModulationPass)
        (modulator,) = self.modulators
        scale, shift = modulator(rms_norm(x), memory_pass.memory, modulator.keys(memory_pass.memory))
        return normed * (1.0 + scale) + shift, gate


@contextmanager
def lerobots_passes(ours: MemoryPI05, memory: MemoryTokens | None) -> Iterator[PI05Pytorch]:
    """Yield a model that computes with the very parameters of ours, by LeRobot's passes, while this lasts."""
    layers: Any = ours.paligemma_with_expert.gemma_expert.model.layers
    norms, passes = [layer.post_attention_layernorm for layer in layers], Passes(ours, memory)
    if ours.fusion is ModulationPass:
        for layer, norm, modulator in zip(layers, norms, ours.modulators, strict=True):  # type: ignore[arg-type]
            layer.post_attention_layernorm = Norm(norm, modulator, passes)
    try:
        yield passes
    finally:
        for layer, norm in zip(layers, norms, strict=True):
            layer.post_attention_layernorm = norm


CHUNK, BATCH, FRAMES = 6, 2, 5


def _config(**fields: object) -> MemobenchMemConfig:
    return small_config(frames=FRAMES, **fields)  # type: ignore[arg-type]


def _inputs(config: MemobenchMemConfig) -> dict[str, object]:
    torch.manual_seed(1)
    side = config.image_size[0]
    words = 12
    masks = torch.ones(BATCH, words, dtype=torch.bool)
    masks[-1, 7:] = False
    return {
        "images": [torch.rand(BATCH, 3, side, side) * 2 - 1],
        "img_masks": [torch.ones(BATCH, dtype=torch.bool)],
        "tokens": torch.randint(0, 200, (BATCH, words)),
        "masks": masks,
        "actions": torch.randn(BATCH, CHUNK, 32),
        "noise": torch.randn(BATCH, CHUNK, 32),
        "time": torch.rand(BATCH),
    }


def _memory(config: MemobenchMemConfig) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    torch.manual_seed(2)
    mask = torch.ones(BATCH, FRAMES, dtype=torch.bool)
    mask[1, 2:] = False
    tokens = torch.randn(BATCH, FRAMES, 16, config.dimensions.vlm.width)
    steps = torch.arange(FRAMES).expand(BATCH, FRAMES)
    return tokens, steps, mask


def _seen(inputs: dict) -> Observation:
    return Observation(inputs["images"], inputs["img_masks"], inputs["tokens"], inputs["masks"])


def _losses(model: MemoryPI05, inputs: dict, memory: MemoryTokens | None = None) -> torch.Tensor:
    drawn = (inputs[key] for key in ("actions", "noise", "time"))
    return model.forward(_seen(inputs), *drawn, model.memory_pass(memory))


def _read(model: MemoryPI05, frames: torch.Tensor, steps: torch.Tensor, mask: torch.Tensor) -> MemoryTokens:
    """Return the memory of these frames (B, F, 16, D)."""
    return model.memory.replay(histories(frames, steps, mask))


def _actions(model: MemoryPI05, inputs: dict, memory: MemoryTokens | None = None) -> torch.Tensor:
    with torch.no_grad():
        memory_pass = model.memory_pass(memory)
    return model.sample_actions(_seen(inputs), inputs["noise"], memory_pass)


def _pair(memory_fusion: str = "modulation") -> tuple[MemoryPI05, MemoryPI05]:
    """LeRobot's model at tiny dimensions with random weights, and the memory model with the same weights."""
    config = _config(memory_fusion=memory_fusion)
    torch.manual_seed(0)
    plain, ours = MemoryPI05(_config(memory="none")).eval(), MemoryPI05(config).eval()
    with torch.no_grad():
        for parameter in plain.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))  # zeros would hide errors
    weights = plain.state_dict()
    missing, unexpected = ours.load_state_dict(weights, strict=False)
    assert not unexpected
    assert set(missing) <= set(ours.memory_parameters())
    return plain, ours


def test_initial_policy_equals_pi05() -> None:
    plain, ours = _pair()
    inputs = _inputs(ours.config)
    memory = _read(ours, *_memory(ours.config))
    assert torch.equal(_losses(plain, inputs), _losses(ours, inputs, memory))
    assert torch.equal(_actions(plain, inputs), _actions(ours, inputs, memory))


@pytest.mark.parametrize(
    "fields",
    [
        {"memory": "none"},
        {"memory_fusion": "modulation"},
        {"memory_fusion": "context"},
        {"memory": "motion", "perception": "objects", "size": "small", "objective": "flow_matching"},
        {"memory": "none", "size": "small", "perception": "objects", "objective": "flow_matching"},
    ],
)
def test_passes_equal_lerobots(fields: dict[str, object]) -> None:
    """Losses, gradients and actions of LeRobot's own passes over the same weights."""
    torch.manual_seed(0)
    ours = MemoryPI05(small_config(**fields)).train()
    with torch.no_grad():
        for name, parameter in ours.named_parameters():
            if "vision_tower" not in name:
                parameter.add_(0.05 * torch.randn_like(parameter))  # zeros would hide errors
    inputs = _inputs(ours.config)
    if ours.state_token is not None:
        shown = torch.arange(SLOTS) < torch.tensor([[5], [3]])
        slots = torch.randn(BATCH, SLOTS, WIDTH)
        slots[..., :2] = torch.stack([shown, torch.arange(SLOTS).expand(BATCH, -1)], dim=-1)
        seen = torch.cat([slots.flatten(1), torch.randn(BATCH, HAND_DIM)], dim=1)
        inputs["images"] = [seen, torch.randn(BATCH, ours.config.max_state_dim)]
        inputs["img_masks"] = [shown, torch.ones(BATCH, dtype=torch.bool)]
    each, mask = torch.randn(BATCH, 2, ours.config.dimensions.vlm.width), torch.arange(2) < torch.tensor([[2], [1]])
    memory = MemoryTokens(each[:, :1], mask[:, :1]) if ours.config.memory == "motion" else MemoryTokens(each, mask)

    def gradients(losses: torch.Tensor) -> list[torch.Tensor | None]:
        ours.zero_grad()
        losses.mean().backward()
        return [losses, *(parameter.grad for parameter in ours.parameters())]

    found = [_actions(ours, inputs, memory), *gradients(_losses(ours, inputs, memory))]
    with lerobots_passes(ours, memory) as theirs:
        observed = {key: inputs[key] for key in ("images", "img_masks", "tokens", "masks", "noise")}
        expected = [theirs.sample_actions(**observed), *gradients(theirs.forward(**inputs))]
    assert sum(one is not None for one in found) > 20
    for one, other in zip(found, expected, strict=True):
        if one is None:  # unread last states of the prefix
            assert other is None or not other.any()
        else:
            torch.testing.assert_close(one, other, rtol=1e-3, atol=2e-6)


@pytest.mark.parametrize("memory_fusion", ["modulation", "context"])
def test_memory_changes_actions_and_padding_does_not(memory_fusion: str) -> None:
    plain, ours = _pair(memory_fusion)
    draw_modulation(ours)
    inputs = _inputs(ours.config)
    tokens, steps, mask = _memory(ours.config)
    actions = _actions(ours, inputs, _read(ours, tokens, steps, mask))
    assert not torch.allclose(actions, _actions(plain, inputs))
    padded = torch.where(mask[:, :, None, None], tokens, torch.full_like(tokens, 50.0))
    torch.testing.assert_close(_actions(ours, inputs, _read(ours, padded, steps, mask)), actions)
    for other in (_read(ours, -tokens, steps, mask), _read(ours, tokens, steps + 40, mask)):
        assert not torch.allclose(_actions(ours, inputs, other), actions)
    memory = _read(ours.train(), tokens, steps, torch.zeros_like(mask))  # fully masked
    _losses(ours, inputs, memory).mean().backward()
    assert all(torch.isfinite(p.grad).all() for p in ours.parameters() if p.grad is not None)
    assert torch.isfinite(_actions(ours, inputs, memory)).all()


def test_instruction_conditions_norms_without_its_padding() -> None:
    config = _config(size="small", perception="objects")
    torch.manual_seed(0)
    model = MemoryPI05(config)
    torch.nn.init.normal_(next(adaptive_norms(model.paligemma_with_expert)).dense.weight)  # zero at first
    tokens = torch.randint(0, 200, (2, 12))
    short = torch.arange(12) < torch.tensor([[12], [7]])
    seen = [torch.zeros(2, SIZE + HAND_DIM), torch.zeros(2, config.max_state_dim)]
    shown = [torch.zeros(2, SLOTS, dtype=torch.bool), torch.ones(2, dtype=torch.bool)]

    def condition(words: torch.Tensor) -> torch.Tensor:
        plain = MemoryPass()
        prefix = model.embed(Observation(seen, shown, words, short), plain)
        (modulation, *_) = model.modulations(torch.ones(2), prefix.instruction, plain)
        return modulation.flatten(1)

    found = condition(tokens)
    assert torch.equal(found, condition(torch.where(short, tokens, 3)))
    other = condition(torch.where(torch.arange(12) == 4, tokens + 1, tokens))
    assert (other != found).any(dim=1).all()
    exchanged = condition(tokens[:, [0, 2, 1, *range(3, 12)]])
    assert ((exchanged - found).abs().amax(dim=1) > 1e-3).all(), "the order of words counts"


def test_gradient_checkpointing_keeps_gradients() -> None:
    _, ours = _pair()
    draw_modulation(ours)
    ours.train()

    def gradients() -> list[torch.Tensor]:
        ours.zero_grad()
        _losses(ours, _inputs(ours.config), _read(ours, *_memory(ours.config))).mean().backward()
        return [p.grad.clone() for p in ours.memory_parameters().values()]

    plain = gradients()
    ours.config.gradient_checkpointing = True
    for a, b in zip(plain, gradients(), strict=True):
        torch.testing.assert_close(a, b)


def test_full_size_is_pi05_plus_the_memory() -> None:
    config = MemobenchMemConfig(size="pi05", device="cpu")
    with torch.device("meta"):
        ours = MemoryPI05(config)
        lerobots = PI05Pytorch(PI05Config(device="cpu"))
    memory = ours.memory_parameters()
    own = {name: p.shape for name, p in ours.named_parameters() if name not in memory}
    assert own == {name: p.shape for name, p in lerobots.named_parameters()}
    assert 85e6 < sum(p.numel() for p in memory.values()) < 95e6
    layers = [sum(p.numel() for n, p in memory.items() if f"modulators.{i}." in n) for i in range(18)]
    assert all(4.7e6 < count < 4.75e6 for count in layers)


# -- image tower ------------------------------------------------------------------------------------------------------


def test_cached_positions_of_a_rollout_have_gradients() -> None:
    with torch.inference_mode():
        rotate_from(torch.ones(1, 3, 8), 1234)
    keys = torch.ones(1, 3, 8, requires_grad=True)
    rotate_from(keys, 1234).square().sum().backward()
    assert keys.grad is not None
    assert keys.grad.isfinite().all()
