"""Draw highlights: translucent discs that mark positions, in the last rows of a draw list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from mujoco_raster.drawlist import HIGHLIGHTS, DrawList, Floats
from mujoco_raster.errors import RasterError

DISC_HALF_HEIGHT = 0.001


@dataclass(frozen=True)
class Highlight:
    """A translucent disc that marks a position, m."""

    position: tuple[float, float, float]
    radius: float
    rgba: tuple[float, float, float, float] = (1.0, 0.85, 0.1, 0.55)


def fill_table(
    table: Floats,
    draw_list: DrawList,
    model: mujoco.MjModel,
    data: mujoco.MjData,
    highlights: Sequence[Highlight],
) -> None:
    """Write the present state of a list's rows and the highlights into a table.

    Raises:
        RasterError: there are more than `HIGHLIGHTS` highlights.
    """
    if len(highlights) > HIGHLIGHTS:
        raise RasterError(f"there are {len(highlights)} highlights in a frame; at most {HIGHLIGHTS} can be drawn")
    draw_list.fill(table, model, data)
    for row, mark in zip(table[-HIGHLIGHTS:], highlights, strict=False):
        row[:3] = np.diag([mark.radius, mark.radius, DISC_HALF_HEIGHT]) @ np.eye(3, 4)
        row[:3, 3] = mark.position
        row[3] = mark.rgba
