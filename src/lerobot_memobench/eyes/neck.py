"""The neck: what lies in a token's square, finer than the token says it. Things that stand close are told apart there.

A token of 192 numbers tells four things in its square from one another badly. So where things are looked for, and not
passed on to a policy as tokens, they are read off the map before the last one, to which the tokens tell what is around
(feature pyramids, Lin et al. 2017).
"""

from __future__ import annotations

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import relu

from lerobot_memobench.eyes.tower import GRID, Block, Tower

FINER = 2
"""Cells of the finer map along a token's side."""


class Neck(nn.Module):
    """Tokens and the map that they are of to a finer map, as wide as that.

    Args:
        tower: whose they are.
    """

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        width = tower.widths[-2]
        self.spread = nn.Linear(tower.width, width * FINER**2)
        self.beside = nn.Conv2d(width, width, 1)
        self.block = Block(width)

    def forward(self, tokens: Tensor, fine: Tensor) -> Tensor:
        """Return (N, 256, width) of tokens (N, 64, tower's width) and their map (N, width, 16, 16), row by row."""
        around = rearrange(
            self.spread(tokens), "n (gy gx) (d y x) -> n d (gy y) (gx x)", gy=GRID, y=FINER, x=FINER
        ).contiguous(memory_format=torch.channels_last)
        return rearrange(self.block(relu(around + self.beside(fine))), "n d y x -> n (y x) d")
