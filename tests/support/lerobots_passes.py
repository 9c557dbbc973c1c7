"""LeRobot's own passes over the weights of our model, with which ours are compared."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import (
    MemoryModulator,
    MemoryPass,
    ModulationPass,
    Prefix,
    rms_norm,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05, Observation


class Passes(PI05Pytorch):
    """pi0.5 as LeRobot computes it, with the tokens and conditions that a memory adds."""

    def __init__(self, ours: MemoryPI05, memory: MemoryTokens | None) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(vars(ours))
        own = {name: getattr(ours.config, name) for name in ("chunk_size", "max_action_dim", "num_inference_steps")}
        self.config = PI05Config(device="cpu", n_action_steps=1, **own)
        self.rtc_processor = None
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
