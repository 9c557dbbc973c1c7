"""What heads say, read off: the things of each picture, where they are, and how sure that is."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import expit
from torch import Tensor
from torch.nn.functional import max_pool2d

from lerobot_memobench.perception.heads import DOUBTS, GEOMETRY, Ask, Said

FOUND = np.dtype(
    [
        ("kind", "u1"),
        ("score", "<f4"),
        ("place", "<f4", 2),
        ("depth", "<f4"),
        ("height", "<f4"),
        ("joint", "<f4"),
        ("lit", "<f4"),
        ("turn", "<f4", 2),
        ("doubt", "<f4", len(DOUBTS)),
    ]
)
"""A thing that was found. ``score``: probability. ``place``: of its origin in the picture, a fraction of its side from
the upper left corner. ``lit``: probability. ``doubt``: how far off it may be: its place, a fraction of the picture's
side, its depth and its height, m; 0 where nothing is said. The others as `heads.GEOMETRY` has them."""
SURE, HOT = 0.03, 0.3
"""Probability from which on a thing counts as found, at a second look and by heat alone: heat promises more."""
MOST = 64
"""Things that are looked for in a picture."""


def found(said: Said) -> list[NDArray[np.void]]:
    """Return the things (n,) of dtype `FOUND` that each picture shows, more probable than `SURE`, or `HOT` where no
    second look is taken, by probability.
    """
    scores, cells = peaks(said)
    scores, order = scores.sort(dim=1, descending=True, stable=True)
    which, rank = torch.nonzero(scores > (HOT if said.sure is None else SURE), as_tuple=True)
    picture, kind, row, column = (cell.gather(1, order)[which, rank] for cell in cells)
    side = said.heat.shape[-1]
    there = (picture, kind, (row + 0.5) / side, (column + 0.5) / side)
    geometry = _between(_placed(said), said.side, *there)
    things = np.zeros(len(picture), FOUND)
    things["kind"], things["score"] = kind.numpy(), scores[which, rank].detach().numpy()
    things["place"] = geometry[:, :2]
    for name in ("depth", "height", "joint"):
        things[name] = geometry[:, GEOMETRY.index(name)]
    things["lit"] = expit(geometry[:, GEOMETRY.index("lit")])
    things["turn"] = geometry[:, -2:]
    if said.doubt is not None:
        things["doubt"] = np.exp(_between(said.doubt, said.side, *there)) / [said.side, 1, 1]
    owner = picture.numpy()
    return [things[owner == number] for number in range(len(scores))]


def peaks(said: Said) -> tuple[Tensor, tuple[Tensor, Tensor, Tensor, Tensor]]:
    """Return the hottest places of pictures, hotter than all around them: probabilities (N, MOST) that they are right,
    0 where there are no more, and picture, kind, row and column of each, (N, MOST).
    """
    heat, side = torch.sigmoid(said.heat), said.heat.shape[-1]
    scores, places = torch.where(heat == max_pool2d(heat, 3, 1, 1), heat, torch.zeros(())).flatten(1).topk(MOST, dim=1)
    pictures = torch.arange(len(heat))[:, None].expand_as(places)
    cells = (pictures, places // side**2, places // side % side, places % side)
    if said.sure is not None:
        every = said.sure(*(cell.flatten() for cell in cells)).view(*scores.shape, -1)
        sure = torch.sigmoid(every.gather(2, cells[1][..., None])[..., 0])
        scores = torch.where(scores > 0, sure, scores)
    return scores, cells


def _placed(said: Said) -> Ask:
    """Return geometry with places in the picture, fractions of its side, instead of offsets from cells."""

    def ask(picture: Tensor, kind: Tensor, row: Tensor, column: Tensor) -> Tensor:
        offset, rest = said.geometry(picture, kind, row, column).split([2, len(GEOMETRY) - 2], dim=1)
        return torch.cat([(offset + torch.stack([column, row], dim=1) + 0.5) / said.side, rest], dim=1)

    return ask


def _between(ask: Ask, side: int, picture: Tensor, kind: Tensor, down: Tensor, across: Tensor) -> NDArray[np.float32]:
    """Return what the four cells around places say, (n, values), the nearer the more."""
    y, x = down * side - 0.5, across * side - 0.5
    whole = total = torch.zeros(len(y), 1)
    for row, column in ((y.floor() + a, x.floor() + b) for a in (0, 1) for b in (0, 1)):
        inside = (row >= 0) & (row < side) & (column >= 0) & (column < side)
        weight = (inside * (1 - (y - row).abs()) * (1 - (x - column).abs()))[:, None]
        cell = (row.long().clamp(0, side - 1), column.long().clamp(0, side - 1))
        whole, total = whole + weight * ask(picture, kind, *cell).detach(), total + weight
    return np.asarray((whole / total).numpy())
