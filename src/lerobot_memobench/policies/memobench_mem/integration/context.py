"""Context: memory tokens join the prefix, behind images and language."""

from __future__ import annotations

import torch
from torch import nn

from lerobot_memobench.policies.memobench_mem.integration.integration import Integration, Prefix
from lerobot_memobench.policies.memobench_mem.memory.tokens import MemoryTokens


class Context(Integration):
    """Memory tokens are seen by the whole prefix and by the actions; nothing is added to the model."""

    def __init__(self, model: nn.Module, memory_dim: int, expert_dim: int) -> None:
        self.memory: MemoryTokens | None = None

    def hand_over(self, memory: MemoryTokens) -> None:
        """Keep this memory for the next prefix."""
        self.memory = memory

    def prefix(self, prefix: Prefix) -> Prefix:
        """Append the memory, which attends and is attended like images and language."""
        if self.memory is None:
            return prefix
        embeddings, real, blocks = prefix
        mask = self.memory.mask
        return (
            torch.cat([embeddings, self.memory.rows().to(embeddings.dtype)], dim=1),
            torch.cat([real, mask], dim=1),
            torch.cat([blocks, torch.zeros_like(mask)], dim=1),
        )
