"""Heads: what a token says of its part of the picture, read off by linear maps alone.

What policies are given are the tokens; that linear maps can read all of this from them is what makes them good.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from einops import rearrange
from torch import Tensor, nn

FINE, COARSE = 4, 2
"""Cells along a token's side: of heat and mask, and of geometry."""
GEOMETRY = ("across", "down", "depth", "height", "joint", "lit", "turn cosine", "turn sine")
"""What is said of a thing of each kind in each coarse cell. ``across``, ``down``: from the cell's middle to its origin,
in cells. ``depth``: of its origin along the camera's view, m. ``height``: of its origin over the table, m. ``joint``:
of a moving part, m or rad. ``lit``: logit that it stands in a highlight. ``turn``: of twice the angle at which its x
axis lies in the picture, see `labels.THING`."""
DOUBTS = ("place", "depth", "height")
"""Of what heads may also say how far off it is: of ``across`` and ``down`` together in cells, of the others in m."""
DOUBTED = (0.3, 0.01, 0.01)
"""How far off they say it is before they have learned."""
RARE = 0.01
"""Probability of a thing in a cell that an untrained head says."""


Ask = Callable[[Tensor, Tensor, Tensor, Tensor], Tensor]
"""From pictures, kinds, rows and columns of coarse cells, (n,) each, to numbers (n, values), float32: of a thing of
that kind there. Asked for few cells it is much less work than saying it of all kinds in all cells."""


@dataclass(frozen=True)
class Said:
    """What heads say of pictures.

    Attributes:
        heat: (N, kinds, fine cells, fine cells), logit that a thing's visible middle is there.
        geometry: len(GEOMETRY) values. side: coarse cells along the picture's side.
        mask: (N, kinds + 1, fine cells, fine cells), logits of what is shown, first of nothing.
        doubt: len(DOUBTS) values, logarithms of how far off the geometry is; None: it is not said.
        sure: as many values as kinds, logits that a thing of each is there, where the heat has a peak of any; None:
            it is as likely as hot.
    """

    heat: Tensor
    geometry: Ask
    side: int
    mask: Tensor
    doubt: Ask | None = None
    sure: Ask | None = None


class Heads(nn.Module):
    """Linear maps from tokens to what they show.

    Args:
        width: of a token. kinds: how many kinds of things there are. grid: side of the square of tokens. fine, coarse:
            cells along a token's side. doubting: say how far off things may be.
    """

    def __init__(
        self, width: int, kinds: int, grid: int, fine: int = FINE, coarse: int = COARSE, *, doubting: bool = False
    ) -> None:
        super().__init__()
        self.grid, self.fine, self.coarse = grid, fine, coarse
        self.heat = nn.Linear(width, kinds * fine**2)
        self.geometry = nn.Linear(width, kinds * len(GEOMETRY) * coarse**2)
        self.mask = nn.Linear(width, (kinds + 1) * fine**2)
        self.doubt = nn.Linear(width, kinds * len(DOUBTS) * coarse**2) if doubting else None
        nn.init.constant_(self.heat.bias, float(torch.logit(torch.tensor(RARE))))
        if self.doubt is not None:
            nn.init.zeros_(self.doubt.weight)
            first = torch.tensor(DOUBTED).log()
            self.doubt.bias.data = first.repeat_interleave(coarse**2).repeat(kinds)

    def forward(self, tokens: Tensor) -> Said:
        """Say what tokens (N, grid * grid, width) show."""
        return Said(
            self._spread(self.heat(tokens)),
            self._asked(self.geometry, tokens, len(GEOMETRY)),
            self.grid * self.coarse,
            self._spread(self.mask(tokens)),
            None if self.doubt is None else self._asked(self.doubt, tokens, len(DOUBTS)),
        )

    def _asked(self, linear: nn.Linear, tokens: Tensor, each: int) -> Ask:
        """Return what a linear map says of so many numbers of each kind in each coarse cell."""
        c, layout = self.coarse, "(k v y x) ... -> (k y x) v ..."
        weight, bias = (rearrange(values, layout, v=each, y=c, x=c) for values in (linear.weight, linear.bias))

        def ask(picture: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
            which = (kind * c + row % c) * c + column % c
            token = (picture * self.grid + row // c) * self.grid + column // c
            seen = tokens.flatten(0, 1).index_select(0, token).float()
            return bias.index_select(0, which) + torch.einsum("nvw,nw->nv", weight.index_select(0, which), seen)

        return ask

    def _spread(self, values: Tensor) -> Tensor:
        """Lay what each token says of its fine cells out as a picture, (N, values, fine cells, fine cells), float32."""
        sides = {"gy": self.grid, "gx": self.grid, "y": self.fine, "x": self.fine}
        return rearrange(values.float(), "n (gy gx) (v y x) -> n v (gy y) (gx x)", **sides)
