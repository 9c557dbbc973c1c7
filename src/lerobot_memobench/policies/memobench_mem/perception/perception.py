"""What a perception is: what the present shows the policy, and what of a frame is remembered."""

from __future__ import annotations

from abc import ABC, abstractmethod

from torch import Tensor


class Perception(ABC):
    """A way to see a moment. A dataset's memory cache and a rollout use the same, so that their tokens agree.

    Attributes:
        remembers: the observation of which a frame's tokens are made.
        tokens_per_frame: P, how many tokens a remembered frame has.
        dim: D, their width.
    """

    remembers: str
    tokens_per_frame: int
    dim: int

    @property
    @abstractmethod
    def key(self) -> str:
        """Identity of the tokens of remembered frames: with equal keys, equal frames have equal tokens."""

    @abstractmethod
    def __call__(self, images: Tensor) -> Tensor:
        """Return what is remembered of N frames, (N, P, D) bfloat16, from their observation; frozen.

        For pictures (N, 3, H, W) in [0, 1].
        """

    @abstractmethod
    def prefix(self, observed: Tensor) -> Tensor:
        """Return the prefix tokens (B, n, d_vlm) of the present, as the policy hands it to the backbone (B, ...)."""
