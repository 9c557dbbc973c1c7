"""Eyes whose finds stand beside their tokens, now and in memory.

A token speaks of 32 x 32 pixels, and says where in them a thing is to 4 mm in the median and to 2 cm at the 90th
percentile; objects are found by a finer map, to 2 mm and 1 cm (docs/eyes.md). A hand that grasps needs the latter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor, nn

from lerobot_memobench.perception.tower import POOLED, WIDTH, Tower
from lerobot_memobench.policies.memobench_mem.perception.eyes import EyePerception, PicturePool
from lerobot_memobench.policies.memobench_mem.perception.found import FoundObjects
from lerobot_memobench.policies.memobench_mem.perception.objects import FramePool
from lerobot_memobench.policies.memobench_mem.perception.perception import Seen
from lerobot_memobench.policies.memobench_mem.perception.pooled_memory import PooledMemory

NUMBERS = POOLED**2 * WIDTH
"""Numbers of a remembered picture's tokens, with which a stored frame begins."""


def _drawn(share: float) -> bool:
    return share > 0 and float(torch.rand(())) < share


class TokenAndFindPool(nn.Module):
    """A stored frame to the tokens of its picture, to each of which a mixture of the things that were found is added.

    Args:
        tokens: of pictures. finds: to as many tokens. dropped: share of the training batches without pictures' tokens.
    """

    def __init__(self, tokens: PicturePool, finds: FramePool, dropped: float = 0.0) -> None:
        super().__init__()
        self.tokens, self.finds, self.dropped = tokens, finds, dropped

    def forward(self, frames: Tensor) -> Tensor:
        """Return tokens (N, 16, width) of frames (N, 1, NUMBERS + SIZE + 6 + 1)."""
        pictures, found = frames[..., :NUMBERS], frames[..., NUMBERS:]
        made: Tensor = self.finds(found)
        if self.training and _drawn(self.dropped):
            return made
        return made + self.tokens(pictures.reshape(-1, POOLED**2, WIDTH))


class FindingEyes(EyePerception):
    """The tokens of all cameras' pictures, and a token for each thing that is found in them.

    Args:
        tower, cameras, camera, width: as of `EyePerception`. finds: with as many tokens of a frame.
        dropped: share of the training batches without pictures' tokens (Neverova et al. 2015, ModDrop); drawn once for
            the present and once for the memory.
    """

    def __init__(
        self,
        tower: Tower,
        cameras: Sequence[str],
        camera: str,
        width: int,
        finds: FoundObjects,
        dropped: float = 0.0,
    ) -> None:
        super().__init__(tower, cameras, camera, width)
        self.finds, self.dropped = finds, dropped

    @property
    def key(self) -> str:
        """Identity of what is remembered."""
        return f"{self.pooled_key}-{self.finds.key}"

    def present(self, batch: Mapping[str, Tensor]) -> Seen:
        """Return each camera's tokens (B, 64, WIDTH), and what is found, as of `FoundObjects`."""
        found, there = self.finds.present(batch)
        if self.training and _drawn(self.dropped):
            return found, there
        tokens, shown = super().present(batch)
        return [*tokens, *found], [*shown, *there]

    def remember(self, batch: Mapping[str, Tensor], rows: Sequence[int]) -> Tensor:
        """Return pooled tokens and what is found of some rows' pictures, one row of numbers each, (n, 1, D')."""
        return self.recall(super().remember(batch, rows), batch, rows)

    def recall(self, pooled: Tensor, columns: Mapping[str, Tensor], frames: Sequence[int]) -> Tensor:
        """Return what `remember` does of recorded frames."""
        found = self.finds.remember(columns, frames)
        return torch.cat([pooled.flatten(1)[:, None].to(found), found], dim=-1)

    def prefix(self, observed: Tensor) -> Tensor:
        """Return prefix tokens (B, n, d_vlm) of a camera's tokens (B, 64, WIDTH), or of what is found (B, D)."""
        return self.finds.prefix(observed) if observed.ndim == 2 else super().prefix(observed)

    def memory(self, encoder: nn.Module) -> nn.Module:
        """Return the encoder behind a pool of each frame."""
        return PooledMemory(TokenAndFindPool(PicturePool(self.dim), self.finds.pool(), self.dropped), encoder)
