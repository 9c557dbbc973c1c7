"""LeRobot's own passes over the weights of our model, which ours are compared with."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from lerobot.policies.pi05.modeling_pi05 import PI05Pytorch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.fusion import ModulatedNorm
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05


class Passes(PI05Pytorch):
    """pi0.5 as LeRobot computes it, with what a fusion adds to its tokens and conditions."""

    def __init__(self, ours: MemoryPI05) -> None:
        nn.Module.__init__(self)
        self.__dict__.update(vars(ours))
        self._ours = [ours]

    def embed_prefix(self, *observed: Any) -> tuple[Tensor, Tensor, Tensor]:
        prefix = self._ours[0].embed_prefix(*observed)
        return prefix.tokens, prefix.real, torch.zeros_like(prefix.real)

    def embed_suffix(self, noisy_actions: Tensor, timestep: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        ours, (tokens, _, blocks, condition) = self._ours[0], super().embed_suffix(noisy_actions, timestep)
        if ours.instruction is not None:
            condition = condition + ours.instruction()
        if ours.fusion is not None:
            tokens, condition = ours.fusion.actions(tokens), ours.fusion.condition(condition)
        real = torch.ones(tokens.shape[:2], dtype=torch.bool)
        blocks = torch.cat([blocks, torch.zeros_like(real).to(blocks)], dim=1)
        return tokens, real, blocks[:, : real.shape[1]], condition


class Norm(nn.Module):
    """LeRobot's norm before a feed-forward, and the memory's modulation behind it."""

    def __init__(self, ours: ModulatedNorm) -> None:
        super().__init__()
        self.ours, self.modulator = ours, ours.modulator

    def forward(self, x: Tensor, cond: Tensor) -> tuple[Tensor, Tensor]:
        normed, gate = self.ours.norm(x, cond=cond)
        assert self.ours.state.memory is not None
        scale, shift = self.ours.modulator(x, self.ours.state.memory)
        return normed * (1.0 + scale) + shift, gate


@contextmanager
def lerobots_passes(ours: MemoryPI05) -> Iterator[PI05Pytorch]:
    """Yield a model that computes with the very parameters of ours, by LeRobot's passes, while this lasts."""
    layers: Any = ours.paligemma_with_expert.gemma_expert.model.layers
    norms = [layer.post_attention_layernorm for layer in layers]
    for layer, norm in zip(layers, norms, strict=True):
        if isinstance(norm, ModulatedNorm):
            layer.post_attention_layernorm = Norm(norm)
    try:
        yield Passes(ours)
    finally:
        for layer, norm in zip(layers, norms, strict=True):
            layer.post_attention_layernorm = norm
