"""What heads should say of labelled pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, cross_entropy, logsigmoid

from lerobot_memobench.perception.finding import peaks
from lerobot_memobench.perception.heads import COARSE, FINE, GEOMETRY, Said
from lerobot_memobench.perception.labels import MASK, Rows, projected
from lerobot_memobench.sim.scene import TABLE_TOP

LEAST = 15
"""Pixels of the rendered picture that must show a thing for it to be taught."""
SIGMA, SPREAD = 0.8, 2
"""How far a thing's heat reaches: standard deviation and half side, in cells."""
BESIDE = 0.2
"""Heat from which on a find is right: the middle's cell and those that touch it."""
SCALES = (1.0, 1.0, 5.0, 5.0, 10.0, 1.0, 0.3, 0.3)
"""What an error of one is worth, for each of `GEOMETRY`: cells, metres (radians), a cross entropy, and parts of a
circle."""
DEPTH, HEIGHT, LIT = (GEOMETRY.index(name) for name in ("depth", "height", "lit"))
REACH = 1.0
"""How far from a cell's middle a thing's origin is said to be at most along each side of the picture, its side being
one: of a door, a stove or a pan the wrist's camera shows a part, and the origin lies outside."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Targets:
    """What heads should say of a batch of pictures.

    Attributes:
        heat: (N, kinds, fine cells, fine cells), 1 at a thing's visible middle, falling off around it.
        cells: (n, 4) of things near coarse cells: picture, kind, row, column.
        geometry: (n, len(GEOMETRY)) of those, NaN where nothing is asked. weights: (n,).
        mask: (N, fine cells, fine cells), kind + 1 of what is shown, 0 for nothing.
    """

    heat: Tensor
    cells: Tensor
    geometry: Tensor
    weights: Tensor
    mask: Tensor


def targets(rows: Rows, kinds: int, grid: int, fine: int = FINE, coarse: int = COARSE) -> Targets:
    """Return what heads should say of pictures (N,).

    Args:
        kinds, grid, fine, coarse: as of `heads.Heads`.
    """
    pictures, places = np.nonzero(
        (np.arange(rows["things"].shape[1]) < rows["count"][:, None]) & (rows["things"]["pixels"] >= LEAST)
    )
    things = rows["things"][pictures, places]
    cells, geometry, weights = _geometry(rows, things, pictures, coarse * grid)
    step = MASK // (fine * grid)
    mask = rows["mask"][:, step // 2 :: step, step // 2 :: step].astype(np.int64)
    return Targets(
        torch.from_numpy(_heat(things, pictures, (len(rows), kinds, fine * grid, fine * grid))),
        torch.from_numpy(cells),
        torch.from_numpy(geometry.astype(np.float32)),
        torch.from_numpy(weights.astype(np.float32)),
        torch.from_numpy(mask),
    )


def _heat(things: Rows, pictures: NDArray[np.int64], shape: tuple[int, int, int, int]) -> NDArray[np.float32]:
    heat, side = np.zeros(shape, np.float32), shape[-1]
    cell = np.clip((things["anchor"] * side).astype(np.int64), 0, side - 1)
    for down in range(-SPREAD, SPREAD + 1):
        for across in range(-SPREAD, SPREAD + 1):
            x, y = cell[:, 0] + across, cell[:, 1] + down
            inside = (x >= 0) & (x < side) & (y >= 0) & (y < side)
            where = (pictures[inside], things["kind"][inside].astype(np.int64), y[inside], x[inside])
            np.maximum.at(heat, where, np.float32(np.exp(-(across**2 + down**2) / (2 * SIGMA**2))))
    return heat


def _geometry(
    rows: Rows, things: Rows, pictures: NDArray[np.int64], side: int
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the four cells around each visible middle, (n, 4), what is asked there and how much that counts."""
    place, depth = projected(things["position"].astype(np.float64), rows[pictures])
    facts = np.column_stack(
        [depth, things["position"][:, 2] - TABLE_TOP, things["joint"], things["lit"], things["turn"]]
    )
    corner = np.floor(things["anchor"] * side - 0.5).astype(np.int64)
    found: list[tuple[NDArray[np.int64], Array, Array]] = []
    for offset in np.ndindex(2, 2):
        cell = corner + np.array(offset)
        far = np.abs(things["anchor"] * side - 0.5 - cell)
        from_middle = np.clip(place * side - 0.5 - cell, -REACH * side, REACH * side)
        index = np.column_stack([pictures, things["kind"], cell[:, 1], cell[:, 0]]).astype(np.int64)
        found.append((index, np.column_stack([from_middle, facts]), np.prod(1 - far, axis=1)))
    cells, geometry, weights = (np.concatenate(parts) for parts in zip(*found, strict=True))
    inside = ((cells[:, 2:] >= 0) & (cells[:, 2:] < side)).all(axis=1)
    order = np.argsort(-weights[inside], kind="stable")  # of two of a kind in a cell the nearer is asked for
    cells, geometry, weights = cells[inside][order], geometry[inside][order], weights[inside][order]
    _, first = np.unique(cells, axis=0, return_index=True)
    return cells[first], geometry[first], weights[first]


def loss(said: Said, wanted: Targets) -> dict[str, Tensor]:
    """Return the losses (scalars) of what heads said: ``heat``, ``place``, ``rest`` and ``mask``."""
    asked = said.geometry(*wanted.cells.T)
    error = (asked - wanted.geometry).abs()
    error[:, LIT] = binary_cross_entropy_with_logits(asked[:, LIT], wanted.geometry[:, LIT], reduction="none")
    error = error * torch.tensor(SCALES)
    error = torch.where(wanted.geometry.isnan(), torch.zeros(()), error) * wanted.weights[:, None]
    each = error.sum(dim=0) / wanted.weights.sum().clamp(min=1.0)
    return {
        "heat": _heat_loss(said.heat, wanted.heat),
        "place": each[:DEPTH].sum(),
        "rest": each[DEPTH:].sum(),
        "mask": cross_entropy(said.mask, wanted.mask),
    }


def doubt_loss(said: Said, wanted: Targets) -> Tensor:
    """Return how badly the doubts of heads fit the errors of their geometry, which learns nothing of it: a Laplace
    distribution's negative logarithm.

    Raises:
        ValueError: they say no doubts.
    """
    if said.doubt is None:
        raise ValueError("these heads have no doubts")
    off = (said.geometry(*wanted.cells.T).detach() - wanted.geometry).abs()
    size = torch.column_stack([torch.linalg.vector_norm(off[:, :2], dim=1), off[:, DEPTH], off[:, HEIGHT]])
    doubt = said.doubt(*wanted.cells.T)
    return ((doubt + size * torch.exp(-doubt)).sum(dim=1) * wanted.weights).sum() / wanted.weights.sum().clamp(min=1.0)


def sure_loss(said: Said, wanted: Targets) -> Tensor:
    """Return how badly the sureness of finds, of all peaks that heads said, fits whether they are right; and that of
    all other kinds at their places, which counts as much and teaches the same network.

    Raises:
        ValueError: it is not said.
    """
    if said.sure is None:
        raise ValueError("these eyes take no second look")
    _, cells = peaks(replace(said, sure=None))  # asked below, once
    picture, kind, row, column = (cell.flatten() for cell in cells)
    right = (wanted.heat[picture, :, row, column] > BESIDE).float()
    every = binary_cross_entropy_with_logits(said.sure(picture, kind, row, column), right, reduction="none")
    return every.gather(1, kind[:, None]).mean() + every.mean()


def _heat_loss(logits: Tensor, heat: Tensor) -> Tensor:
    """CenterNet's focal loss: near a middle less is asked of a cell than far from it."""
    there = heat == 1
    likely = torch.sigmoid(logits.detach())
    weight = torch.where(there, (1 - likely) ** 2, (1 - heat) ** 4 * likely**2)
    return -(weight * logsigmoid(torch.where(there, logits, -logits))).sum() / there.sum().clamp(min=1)
