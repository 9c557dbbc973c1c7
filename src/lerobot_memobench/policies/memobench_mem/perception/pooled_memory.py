"""A memory of frames that are stored as they were seen, and of which it is learned what becomes of each."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class PooledMemory(nn.Module):
    """Stored frames to memory tokens: each through a pool, then the mechanism's encoder over the frames.

    Args:
        pool: from N frames (N, P, D') to their tokens (N, P'', D). encoder: of (B, F, P'', D).
    """

    def __init__(self, pool: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.pool, self.encoder = pool, encoder

    def forward(
        self, frames: Tensor, steps: Tensor, mask: Tensor, numbers: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Encode frames (B, F, P, D') seen at steps (B, F), of which mask (B, F) are real.

        Args:
            numbers: (B, F), equal where frames are: each is pooled once, however many rows read it.

        Returns:
            H (B, L, d_m) and its mask (B, L).
        """
        rows = frames.flatten(0, 1)
        if numbers is None:
            pooled = self.pool(rows)
        else:
            unique, places = numbers.flatten().unique(return_inverse=True)
            first = places.new_zeros(len(unique)).scatter_(0, places, torch.arange(len(places), device=places.device))
            pooled = self.pool(rows[first])[places]
        memory, real = self.encoder(pooled.unflatten(0, mask.shape), steps, mask)
        return memory, real
