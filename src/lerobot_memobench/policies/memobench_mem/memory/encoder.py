"""Encoders of remembered frames to memory tokens: a frame's tokens, joined with their time and place in the picture.

As RoboMME's pi0.5 memory module. Shapes: B rows, F frames, P = 16 tokens per frame,
D width of the vision tokens, d_m width of memory tokens.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MEMORY_GRID

POSITION_DIM = 768
_FREQUENCIES = 128
_TIME_BASE, _SPACE_BASE = 10_000.0, 1_000.0


def position_features(steps: Tensor) -> Tensor:
    """Sinusoids of control step and grid place: (..., ) int steps -> (..., 16, 768) float32.

    Order: sin t, cos t, sin y, cos y, sin x, cos x, 128 frequencies each from 1 down to 1/base. Token i of a grid row
    lies at 4 i + 2 of the 16 patches (its middle), y runs over rows.
    """
    grid = _grid_waves(steps.device)
    time = rearrange(_waves(steps, _TIME_BASE), "... d -> ... 1 d")
    rows, columns = repeat(grid, "y d -> (y x) d", x=MEMORY_GRID), repeat(grid, "x d -> (y x) d", y=MEMORY_GRID)
    return torch.cat(torch.broadcast_tensors(time, rows, columns), dim=-1)


def _waves(values: Tensor, base: float) -> Tensor:
    """Sines, then cosines, of values (...) at 128 frequencies from 1 down to 1/base: (..., 256) float32."""
    exponents = torch.arange(_FREQUENCIES, dtype=torch.float32, device=values.device) / (_FREQUENCIES - 1)
    angles = rearrange(values.to(torch.float32), "... -> ... 1") * base**-exponents
    return torch.cat([angles.sin(), angles.cos()], dim=-1)


def _grid_waves(device: torch.device) -> Tensor:
    """Waves (4, 256) of the rows, or columns, of the token grid."""
    return _waves(4.0 * torch.arange(MEMORY_GRID, dtype=torch.float32, device=device) + 2.0, _SPACE_BASE)


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
        """`position` of `position_features` (..., 16, 768), by its parts; (..., 1, d_m) of the time alone."""
        weight = self.position.weight
        if not self.grid:
            return rearrange(self.position(_waves(steps, _TIME_BASE).to(weight.dtype)), "... d -> ... 1 d")
        of_time, of_row, of_column = weight.split(2 * _FREQUENCIES, dim=1)
        grid = _grid_waves(steps.device).to(weight.dtype)
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
