"""What a memory mechanism is: what it writes per frame, what it reads per plan, and how large both become.

A mechanism is a rule without weights: it says which frames of an episode stay, and which of them a plan sees. What is
learned, how those frames become memory tokens, is its encoder, through which gradients flow to every frame read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.dimensions import GRID
from lerobot_memobench.policies.memobench_mem.memory.encoder import MemoryEncoder


@dataclass(frozen=True)
class Frame:
    """One moment: its control step since the episode began, and its tokens (P, D) on the CPU."""

    step: int
    tokens: Tensor


class EpisodeFrames(Protocol):
    """The frames of a recorded episode that a rollout would have offered for writing, numbered 0, 1, 2, ..."""

    def load(self, slots: Sequence[int]) -> list[Frame]:
        """Load these frames, and no others."""
        ...


class MemoryMechanism(ABC):
    """A rule by which an episode is remembered.

    Attributes:
        name: by which it is chosen.
        frames: how many frames a plan reads at most; with 0 no frame is looked at, and training loads none.
        capacity: how many frames are kept of an episode at most; None where all are, however many come.
    """

    name: ClassVar[str]
    capacity: int | None

    def __init__(self, frames: int) -> None:
        self.frames = frames

    @abstractmethod
    def write(self, kept: list[Frame], frame: Frame) -> None:
        """Take in an episode's next frame: change what is ``kept`` of the earlier ones, in place."""

    @abstractmethod
    def read(self, kept: Sequence[Frame]) -> list[Frame]:
        """Return what a plan sees of what is kept: at most `frames` frames, the oldest first."""

    def recall(self, episode: EpisodeFrames, slot: int) -> list[Frame]:
        """Return what training reads at an episode's frame ``slot``: what a rollout reads there.

        This loads and writes frames 0 ... ``slot`` one by one. A mechanism whose reading can be told from their number
        alone loads those that it reads instead; a test holds both to the same result.
        """
        kept: list[Frame] = []
        for frame in episode.load(range(slot + 1)):
            self.write(kept, frame)
        return self.read(kept)

    def encoder(self, image_dim: int, memory_dim: int, grid: int = GRID) -> nn.Module:
        """Build what turns frames read into memory tokens.

        It is called with tokens (B, F, P, D), their control steps (B, F) and which frames are real (B, F), and returns
        tokens (B, L, d_m) and their mask (B, L). A recurrent memory goes through the frames here, in their order; one
        that looks at each frame alone says so (``framewise = True``) and is given a frame that many rows read once.

        Args:
            grid: side of the square of a picture's tokens; 0 where tokens have no place in a picture.
        """
        return MemoryEncoder(image_dim, memory_dim, grid)
