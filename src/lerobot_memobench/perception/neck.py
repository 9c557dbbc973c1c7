"""The neck: what lies in a token's square, finer than the token says it. Things that stand close are told apart there.

A token of 192 numbers tells four things in its square from one another badly. So where things are looked for, and not
passed on to a policy as tokens, they are read off a map four times as fine, to which the tokens tell what is around
(feature pyramids, Lin et al. 2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import torch
from einops import rearrange
from torch import Tensor, nn
from torch.nn.functional import relu

from lerobot_memobench.perception.tower import GRID, Block, Tower

STEPS = 2
"""How often the neck halves the cells of a token's square."""
FINER = 2**STEPS
"""Cells of the finest map along a token's side."""


class Step(nn.Module):
    """A map, and the tower's that is twice as fine, to another one like that.

    Args:
        above, beside: channels of the two.
    """

    def __init__(self, above: int, beside: int) -> None:
        super().__init__()
        self.spread = nn.Linear(above, 4 * beside)
        self.beside = nn.Conv2d(beside, beside, 1)
        self.block = Block(beside)

    def forward(self, above: Tensor, beside: Tensor) -> Tensor:
        """(N, side, side, above) and (N, beside, 2 side, 2 side) to (N, 2 side, 2 side, beside)."""
        around = rearrange(self.spread(above), "n gy gx (d y x) -> n d (gy y) (gx x)", y=2, x=2)
        around = around.contiguous(memory_format=torch.channels_last)
        return self.block(relu(around + self.beside(beside))).permute(0, 2, 3, 1)


class Neck(nn.Module):
    """Tokens and the tower's maps to a finer map, as wide as that of the tower that is as fine.

    Args:
        tower: whose they are.
    """

    def __init__(self, tower: Tower) -> None:
        super().__init__()
        widths = tower.widths[: -2 - STEPS : -1]
        self.width = widths[-1]
        self.steps = nn.ModuleList(Step(*pair) for pair in pairwise(widths))

    def forward(self, tokens: Tensor, maps: Sequence[Tensor]) -> Tensor:
        """Return (N, (8 FINER)², width) of tokens (N, 64, tower's width) and the tower's maps, row by row."""
        x = tokens.unflatten(1, (GRID, GRID))
        for step, beside in zip(self.steps, reversed(maps), strict=False):
            x = step(x, beside)
        return x.flatten(1, 2)
