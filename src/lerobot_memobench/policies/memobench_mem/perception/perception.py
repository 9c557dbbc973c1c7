"""What a perception is: what the present shows the policy, and what of a frame is remembered."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

from torch import Tensor, nn

Seen = tuple[list[Tensor], list[Tensor]]
"""What is seen now, in the place of LeRobot's images: parts (B, ...), and which of each one's tokens are real: (B,)
for all of them, or (B, n)."""


class Perception(ABC):
    """A way to see a moment. Training and a rollout use the same, so that what they remember agrees.

    Attributes:
        remembers: the observation of which a frame's tokens are made, without which nothing is seen.
        dim: D, width of the tokens that the memory's encoder is given.
        grid: side of the square of a picture's tokens; 0 where tokens have no place in a picture.
        pictures: whether it looks at pictures, which an environment may repeat.
    """

    remembers: str
    dim: int
    grid: int
    pictures: bool

    @property
    @abstractmethod
    def key(self) -> str:
        """Identity of what is remembered of frames: with equal keys, equal frames are remembered alike."""

    @abstractmethod
    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return what is remembered of some rows of an observation, (n, P, D'); nothing in it learns."""

    def present(self, batch: Mapping[str, Tensor]) -> Seen | None:
        """Return what is seen now of a batch of observations; None where it is LeRobot's images."""
        return None

    @abstractmethod
    def prefix(self, observed: Tensor) -> Tensor:
        """Return the prefix tokens (B, n, d_vlm) of one part of the present (B, ...)."""

    def memory(self, encoder: nn.Module) -> nn.Module:
        """Return what makes memory tokens of remembered frames, given the mechanism's encoder of (B, F, P, D)."""
        return encoder
