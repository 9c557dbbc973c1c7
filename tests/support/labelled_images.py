"""Shared by tests of the detector: a small encoder, reset scenes, and labelled images without a simulator.

Those show bright squares on a dark ground from straight above.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.perception.detector import GEOMETRY, CellQuery, DetectorOutput
from lerobot_memobench.perception.objects import rays
from lerobot_memobench.perception.visual_encoder import SIDE, VisualEncoder
from lerobot_memobench.sim.asset import TABLE_TOP
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from research.detector.labels import MASK, PICTURE, Rows
from research.detector.training import LIT, Targets

BOWLS = "put_the_butter_into_the_bowl_from_the_prompt_video"
DRAWERS = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
HEIGHT, SLOPE, HALF = 0.8, 0.4, 12
"""Of the camera over the table, m; tangent of half its field of view; half a square's side, pixels."""


def small_encoder() -> VisualEncoder:
    return VisualEncoder((4, 4, 8, 8, 16), (0, 0, 0, 1, 0))


def simulation(name: str) -> Simulation:
    sim = Simulation(get_task(name))
    sim.reset(20_000)
    return sim


def synthetic(count: int, kinds: int = 3, *, camera: str = "agentview", seed: int = 0) -> Rows:
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


def perfect(wanted: Targets, side: int) -> DetectorOutput:
    """Return the output of heads without any error, with so many coarse cells along an image."""
    pictures, kinds, _, _ = wanted.heat.shape
    geometry = torch.zeros(pictures, kinds, len(GEOMETRY), side, side)
    picture, kind, row, column = wanted.cells.T
    output = wanted.geometry.nan_to_num()
    output[:, LIT] = torch.where(output[:, LIT] > 0.5, 10.0, -10.0)
    geometry[picture, kind, :, row, column] = output
    mask = 20 * torch.nn.functional.one_hot(wanted.mask, kinds + 1).float().permute(0, 3, 1, 2)
    return DetectorOutput(torch.where(wanted.heat == 1, 10.0, -10.0), laid_out(geometry), side, mask)


def laid_out(values: Tensor) -> CellQuery:
    """Return a query of values (N, kinds, values, side, side)."""
    return lambda picture, kind, row, column: values[picture, kind, :, row, column]


def everywhere(query: CellQuery, shape: tuple[int, ...]) -> Tensor:
    """Query every kind in every cell, (n, values), of so many images, kinds and cells along a side."""
    return query(*torch.cartesian_prod(*map(torch.arange, (*shape, shape[-1]))).T)


def trained_a_little(encoder: VisualEncoder) -> VisualEncoder:
    """Fill the running statistics of batch normalisation."""
    encoder.train()
    for _ in range(3):
        encoder(torch.rand(4, 3, SIDE, SIDE))
    return encoder.eval()


def all_outputs(output: DetectorOutput) -> list[Tensor]:
    """Return the output except uncertainty and score; geometry is computed now."""
    cells = (*output.heatmap.shape[:2], output.side)
    return [output.heatmap, output.mask, everywhere(output.geometry, cells)]
