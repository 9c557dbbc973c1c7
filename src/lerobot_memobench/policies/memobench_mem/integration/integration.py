"""What an integration of memory into pi0.5 is."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.memory.tokens import MemoryTokens

Prefix = tuple[Tensor, Tensor, Tensor]
"""LeRobot's prefix: embeddings (B, N, D), which of them are real (B, N), and where attention blocks begin (B, N)."""


class Integration(ABC):
    """A way by which actions read memory tokens; made once for a model, to which it may add parameters."""

    @abstractmethod
    def __init__(self, model: nn.Module, memory_dim: int, expert_dim: int) -> None:
        """Make ``model`` ready: memory tokens are ``memory_dim`` wide, the action expert ``expert_dim``."""

    @abstractmethod
    def hand_over(self, memory: MemoryTokens) -> None:
        """Take the memory, of width d_m, that the next passes read."""

    def prefix(self, prefix: Prefix) -> Prefix:
        """Return the prefix that the model sees, given LeRobot's."""
        return prefix

    def owns(self, name: str) -> bool:
        """Say whether a parameter of the model is this integration's, and no part of pi0.5."""
        return False

    def place_of(self, name: str) -> str:
        """Return the name in this model of a parameter of plain pi0.5."""
        return name
