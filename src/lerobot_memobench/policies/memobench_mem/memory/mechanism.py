"""Interface of memory mechanisms, what training reads by them, and encoders of remembered frames to memory tokens.

A mechanism is a rule without weights: which frames of an episode are kept, and which of them are read for an action
chunk. Its encoder, which makes memory tokens of the frames read, is learned; the one here is that of RoboMME's pi0.5,
which joins a frame's tokens with their time and place in the picture.

Shapes: B rows, F frames, P tokens per frame, D their width, d_m width of memory tokens, L memory tokens of a row.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.datasets.feature_cache.reading import FrameLookup
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_GRID


@dataclass(frozen=True)
class Frame:
    """A frame: its control step since the episode began, and its tokens (P, D) on the CPU."""

    step: int
    tokens: Tensor


Load = Callable[[Sequence[int]], list[Frame]]
"""Loads frames of a recorded episode, and no others, by their numbers 0, 1, 2, ... among those that a rollout would
have written."""


class MemoryMechanism(ABC):
    """A rule by which an episode is remembered.

    Attributes:
        name: by which it is chosen.
        frames: how many frames a chunk reads at most; with 0 none is encoded, and training loads none.
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
        """Return the frames that a chunk reads of those kept: at most `frames`, the oldest first."""

    def recall(self, load: Load, slot: int) -> list[Frame]:
        """Return what training reads at an episode's frame ``slot``: what a rollout reads there.

        This loads and writes frames 0 ... ``slot`` one by one. A mechanism whose reading can be told from their number
        alone loads those that it reads instead; a test holds both to the same result.
        """
        kept: list[Frame] = []
        for frame in load(range(slot + 1)):
            self.write(kept, frame)
        return self.read(kept)

    def encoder(self, image_dim: int, memory_dim: int, grid: int = MEMORY_GRID) -> nn.Module:
        """Build what turns frames read into memory tokens.

        It is called with tokens (B, F, P, D), their control steps (B, F) and which frames are real (B, F), and returns
        tokens (B, L, d_m) and their mask (B, L). A recurrent memory goes through the frames here, in their order; one
        that looks at each frame alone says so (``framewise = True``) and is given a frame that many rows read once.

        Args:
            grid: side of the square of a picture's tokens; 0 where tokens have no place in a picture.
        """
        return MemoryEncoder(image_dim, memory_dim, grid)


# -- frames in a batch ------------------------------------------------------------------------------------------------


TOKENS, STEPS, MASK = "memory.tokens", "memory.steps", "memory.mask"
FRAMES = "memory.frames"
"""Numbers (B, F) of remembered frames in the dataset, by which samples of one episode share what they remember; -1
where a row has none."""
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"


class MemoryBatch(NamedTuple):
    """Frames read for B samples: tokens (B, F, P, D), control steps (B, F) int64, mask (B, F) bool."""

    tokens: Tensor
    steps: Tensor
    mask: Tensor

    def to(self, device: torch.device) -> MemoryBatch:
        """Move it to a device."""
        return MemoryBatch(*(tensor.to(device) for tensor in self))


def collate_frames(rows: Sequence[Sequence[Frame]], frames: int) -> MemoryBatch:
    """Right-pad what was read for each sample to ``frames`` frames."""
    like = rows[0][0].tokens
    batch = MemoryBatch(
        tokens=torch.zeros(len(rows), frames, *like.shape, dtype=like.dtype),
        steps=torch.zeros(len(rows), frames, dtype=torch.int64),
        mask=torch.zeros(len(rows), frames, dtype=torch.bool),
    )
    for number, row in enumerate(rows):
        batch.tokens[number, : len(row)] = torch.stack([frame.tokens for frame in row])
        batch.steps[number, : len(row)] = torch.tensor([frame.step for frame in row])
        batch.mask[number, : len(row)] = True
    return batch


def recall_at(cache: FrameLookup, mechanism: MemoryMechanism, episode: int, frame: int) -> list[Frame]:
    """Return what ``mechanism`` reads in a cache at a frame of an episode, counted from its start."""
    stride = cache.meta.stride

    def load(slots: Sequence[int]) -> list[Frame]:
        tokens = cache.tokens(episode, slots)
        return [Frame(slot * stride, one) for slot, one in zip(slots, tokens.unbind(), strict=True)]

    return mechanism.recall(load, frame // stride)


# -- encoders ---------------------------------------------------------------------------------------------------------


POSITION_DIM = 768
_FREQUENCIES = 128
_TIME_BASE, _SPACE_BASE = 10_000.0, 1_000.0


def _waves(values: Tensor, base: float) -> Tensor:
    """Sines, then cosines, of values (...) at 128 frequencies from 1 down to 1/base: (..., 256) float32."""
    exponents = torch.arange(_FREQUENCIES, dtype=torch.float32, device=values.device) / (_FREQUENCIES - 1)
    angles = rearrange(values.to(torch.float32), "... -> ... 1") * base**-exponents
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


class MemoryEncoder(nn.Module):
    """Vision tokens and their positions to memory tokens: concat(image, SiLU(Linear(position))) -> Linear.

    A Linear of a concatenation is the sum of its parts' Linears. The 16 tokens of a frame share their time and all
    frames share their grid, so the first Linear is applied to F times and 4 + 4 places instead of F * 16 tokens.
    Tokens without a ``grid`` are joined with their time alone.
    """

    framewise = True

    def __init__(self, image_dim: int, memory_dim: int, grid: int = MEMORY_GRID) -> None:
        super().__init__()
        self.grid = grid
        self.position = nn.Linear(POSITION_DIM, POSITION_DIM) if grid else nn.Linear(2 * _FREQUENCIES, memory_dim)
        self.project = nn.Linear(image_dim + self.position.out_features, memory_dim)

    def forward(self, tokens: Tensor, steps: Tensor, frame_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encode tokens (B, F, P, D) of control steps (B, F).

        Returns:
            H (B, F*P, d_m) float32 and its mask (B, F*P) bool, from ``frame_mask`` (B, F).
        """
        of_image, of_position = self.project.weight.split([tokens.shape[-1], self.position.out_features], dim=1)
        image = F.linear(tokens.to(of_image.dtype), of_image, self.project.bias)
        # A training batch gives its frames one by one (`PooledMemoryEncoder.shared`), of a tenth as many steps.
        at, places = steps.unique(return_inverse=True) if steps.shape[1] == 1 else (steps, None)
        positions = F.linear(F.silu(self._positions(at)), of_position)
        if places is not None:
            positions = positions.index_select(0, places.flatten()).unflatten(0, places.shape)
        encoded = image + positions
        mask = repeat(frame_mask.bool(), "b f -> b (f p)", p=tokens.shape[2])
        return rearrange(encoded, "b f p d -> b (f p) d"), mask

    def _positions(self, steps: Tensor) -> Tensor:
        """Return `position` of each token (..., 16, 768); of a frame's time alone (..., 1, d_m) without a grid.

        Its input is sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each from 1 down to 1/base. Token i of a
        grid row lies at 4 i + 2 of the 16 patches (its middle), y runs over rows.
        """
        weight = self.position.weight
        if not self.grid:
            return rearrange(self.position(_waves(steps, _TIME_BASE).to(weight.dtype)), "... d -> ... 1 d")
        of_time, of_row, of_column = weight.split(2 * _FREQUENCIES, dim=1)
        middles = 4.0 * torch.arange(MEMORY_GRID, dtype=torch.float32, device=steps.device) + 2.0
        grid = _waves(middles, _SPACE_BASE).to(weight.dtype)
        time = F.linear(_waves(steps, _TIME_BASE).to(weight.dtype), of_time, self.position.bias)
        rows = rearrange(F.linear(grid, of_row), "y d -> y 1 d")
        columns = rearrange(F.linear(grid, of_column), "x d -> 1 x d")
        return rearrange(time, "... d -> ... 1 d") + rearrange(rows + columns, "y x d -> (y x) d")


class MemoryTokens(NamedTuple):
    """Tokens that B rows read, L each.

    Attributes:
        each: (B, L, d), or (U, P, d) of U frames.
        mask: (B, L) bool, which are real.
        places: (B, F), which of the U frames each row reads, with F P = L; None where ``each`` lies in rows.
    """

    each: Tensor
    mask: Tensor
    places: Tensor | None = None

    def through(self, made: Callable[[Tensor], Tensor]) -> MemoryTokens:
        """Return what is made of every token by itself."""
        return self._replace(each=made(self.each))

    def rows(self) -> Tensor:
        """Return what each row reads, (B, L, d)."""
        if self.places is None:
            return self.each
        return self.each.index_select(0, self.places.flatten()).unflatten(0, self.places.shape).flatten(1, 2)


class PooledMemoryEncoder(nn.Module):
    """Stored frames to memory tokens: each through a pool, then the mechanism's encoder over the frames.

    Args:
        pool: from N frames (N, P, D') to their tokens (N, P'', D). encoder: of (B, F, P'', D).
    """

    def __init__(self, pool: nn.Module, encoder: nn.Module) -> None:
        super().__init__()
        self.pool, self.encoder = pool, encoder

    def forward(self, frames: Tensor, steps: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encode frames (B, F, P, D') of steps (B, F), of which mask (B, F) are real.

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
