"""A memory of frames that are stored as they were seen, and of which it is learned what becomes of each."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.tokens import MemoryTokens


class PooledMemory(nn.Module):
    """Stored frames to memory tokens: each through a pool, then the mechanism's encoder over the frames.

    Args:
        pool: from N frames (N, P, D') to their tokens (N, P'', D). encoder: of (B, F, P'', D).
    """

    def __init__(self, pool: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.pool, self.encoder = pool, encoder

    def forward(self, frames: Tensor, steps: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encode frames (B, F, P, D') seen at steps (B, F), of which mask (B, F) are real.

        Returns:
            H (B, L, d_m) and its mask (B, L).
        """
        memory, real = self.encoder(self.pool(frames.flatten(0, 1)).unflatten(0, mask.shape), steps, mask)
        return memory, real

    def shared(self, frames: Tensor, steps: Tensor, mask: Tensor, numbers: Tensor) -> MemoryTokens:
        """Encode what `forward` does; a frame that many rows read is pooled once, and, if the encoder is ``framewise``,
        encoded once.

        Args:
            numbers: (B, F), equal where frames and their steps are.
        """
        unique, places = numbers.unique(return_inverse=True)
        order = torch.arange(places.numel(), device=places.device)
        first = places.new_zeros(len(unique)).scatter_(0, places.flatten(), order)
        pooled = self.pool(frames.flatten(0, 1)[first])
        if not getattr(self.encoder, "framewise", False):
            return MemoryTokens(*self.encoder(pooled[places], steps, mask))
        each, real = self.encoder(pooled.unsqueeze(1), steps.flatten()[first, None], mask.flatten()[first, None])
        return MemoryTokens(each, real[places].flatten(1, 2), places)
