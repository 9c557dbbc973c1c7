"""Labelled pictures without a simulator: bright squares on a dark ground, seen straight from above."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.perception.heads import GEOMETRY, Ask, Said
from lerobot_memobench.perception.labels import MASK, PICTURE, Rows, rays
from lerobot_memobench.perception.targets import LIT, Targets
from lerobot_memobench.perception.tower import SIDE
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS

HEIGHT, SLOPE, HALF = 0.8, 0.4, 12
"""Of the camera over the table, m; tangent of half its field of view; half a square's side, pixels."""


def made_up(count: int, kinds: int = 3, *, camera: str = "agentview", seed: int = 0) -> Rows:
    """Return pictures (count,) that show one square of each kind, in a colour and a third of the picture of its own."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, PICTURE)
    rows["pixels"] = rng.integers(0, 40, rows["pixels"].shape)
    rows["camera"], rows["count"] = list(MJCF_CAMERAS).index(camera), kinds
    rows["eye"], rows["turned"], rows["slope"] = (0.0, 0.0, TABLE_TOP + HEIGHT), np.eye(3), SLOPE
    for row in rows:
        for kind in range(kinds):
            _show(row, kind, kinds, rng)
    return rows


def _show(row: Rows, kind: int, kinds: int, rng: np.random.Generator) -> None:
    third = SIDE / kinds
    x, y = rng.uniform(kind * third + HALF, (kind + 1) * third - HALF), rng.uniform(HALF, SIDE - HALF)
    place, angle = np.array([x, y]) / SIDE, rng.uniform(-np.pi, np.pi)
    box = (slice(int(y) - HALF + 1, int(y) + HALF), slice(int(x) - HALF + 1, int(x) + HALF))
    row["pixels"][:, *box] = 60
    row["pixels"][kind, *box] = 250
    step = SIDE // MASK
    row["mask"][box[0].start // step : box[0].stop // step, box[1].start // step : box[1].stop // step] = kind + 1
    position = row["eye"] + rays(place, row) * HEIGHT
    turn = (np.cos(angle), np.sin(angle))
    row["things"][kind] = (kind, 400, place, position, 0.1 * kind if kind < 2 else np.nan, kind == 1, turn)


def perfect(wanted: Targets, side: int) -> Said:
    """Return what heads with so many coarse cells along a picture say that have learned all there is to learn."""
    pictures, kinds, _, _ = wanted.heat.shape
    geometry = torch.zeros(pictures, kinds, len(GEOMETRY), side, side)
    picture, kind, row, column = wanted.cells.T
    said = wanted.geometry.nan_to_num()
    said[:, LIT] = torch.where(said[:, LIT] > 0.5, 10.0, -10.0)
    geometry[picture, kind, :, row, column] = said
    mask = 20 * torch.nn.functional.one_hot(wanted.mask, kinds + 1).float().permute(0, 3, 1, 2)
    return Said(torch.where(wanted.heat == 1, 10.0, -10.0), laid_out(geometry), side, mask)


def laid_out(values: Tensor) -> Ask:
    """Return what says of cells what stands there in (N, kinds, values, side, side)."""
    return lambda picture, kind, row, column: values[picture, kind, :, row, column]


def everywhere(ask: Ask, shape: tuple[int, ...]) -> Tensor:
    """Ask of every kind in every cell, (n, values), given how many pictures, kinds and cells along a side there are."""
    return ask(*torch.cartesian_prod(*map(torch.arange, (*shape, shape[-1]))).T)
