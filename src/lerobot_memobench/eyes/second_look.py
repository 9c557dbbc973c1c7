"""A second look at finds: how sure they are, by what is around them and what else the same place is taken for.

A cell's heat is read off its own numbers by a linear map, kind by kind: where little shows, it speaks of several kinds
at once, and each may pass for found. Only the few peaks are looked at again, so this may be a network, and wider.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import max_pool2d, relu

from lerobot_memobench.eyes.heads import Ask

HIDDEN = 32
"""Width of the network."""
OTHERS = 3
"""Hottest other kinds at a find, or in a cell beside it, that it is weighed against."""


class SecondLook(nn.Module):
    """From the finer map and its heat to how sure finds are.

    Args:
        width: of the map. kinds: how many kinds of things there are.
    """

    def __init__(self, width: int, kinds: int) -> None:
        super().__init__()
        self.around = nn.Conv2d(width, HIDDEN, 3, padding=1)
        self.heard = nn.Linear(1 + min(OTHERS, kinds - 1), HIDDEN, bias=False)
        self.kind = nn.Embedding(kinds, HIDDEN)
        self.sure = nn.Linear(HIDDEN, 1)

    def forward(self, fine: Tensor, heat: Tensor) -> Ask:
        """Return what says of peaks whether they are right, a logit each.

        Args:
            fine: (N, side², width) the finer map, row by row. heat: (N, kinds, side, side) its logits.
        """
        side = heat.shape[-1]

        def ask(picture: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
            around = self.around(fine.unflatten(1, (side, side)).permute(0, 3, 1, 2).float())
            others = max_pool2d(heat, 3, 1, 1)[picture, :, row, column].scatter(1, kind[:, None], -torch.inf)
            own = heat[picture, kind, row, column][:, None]
            heard = torch.cat([own, others.topk(self.heard.in_features - 1, dim=1).values], dim=1)
            seen: Tensor = around[picture, :, row, column] + self.heard(heard) + self.kind(kind)
            return self.sure(relu(seen))

        return ask
