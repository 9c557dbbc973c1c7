"""How much an action chunk reads of each entry that is remembered: a frame, a keyframe, a slot."""

from __future__ import annotations

from typing import NamedTuple

import torch
from einops import einsum
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryTokens


class ChunkReads(NamedTuple):
    """What one chunk has read.

    Attributes:
        step: control step since the episode began at which it was planned.
        entries: those that it could read: a frame's control step, in ascending order; -1, -2, ... the first, second ...
            memory token, where tokens are of no frame.
        weights: how much of each, in the same order: shares of attention, which sum to one where it is paid to memory
            alone.
    """

    step: int
    entries: tuple[int, ...]
    weights: tuple[float, ...]


def chunk_reads(steps: list[int], memory: MemoryTokens, layers: list[Tensor]) -> list[ChunkReads]:
    """Return what chunks of B rows read, which are planned at these control steps.

    Args:
        layers: how much was read of each token in each layer and pass, (B, L) each. Their mean counts, and of an entry
            the sum over its tokens, or over its shares of tokens (`MemoryTokens.sources`).
    """
    weights, real = torch.stack(layers).float().mean(dim=0), memory.mask
    if memory.sources is not None:
        shares, entries = memory.sources
        weights, real = einsum(weights, shares, "b l, b l e -> b e"), entries >= 0
    else:
        entries = (-1 - torch.arange(real.shape[1], device=real.device)).expand_as(real)
        if memory.steps is not None:
            entries = torch.where(memory.steps < 0, entries, memory.steps)
    found = []
    for step, of, each, there in zip(steps, entries, weights, real, strict=True):
        named, place = of[there].float().round().long().unique(return_inverse=True)
        shares = torch.zeros(len(named), device=each.device).index_add(0, place, each[there].float())
        found.append(ChunkReads(step, tuple(named.tolist()), tuple(shares.tolist())))
    return found
