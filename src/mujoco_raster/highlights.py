"""Draw highlights: translucent discs that mark positions, appended to the rows of a draw list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.drawlist import TABLE_LINES, VERTEX, DrawList, Floats
from mujoco_raster.errors import RasterError
from mujoco_raster.shapes import disc

HIGHLIGHTS = 16
"""Maximum number of highlights in a frame."""
DISC_HALF_HEIGHT = 0.001
_MATERIAL = (0.0, 1.0, 0.3, 0.0)


@dataclass(frozen=True)
class Highlight:
    """A translucent disc that marks a position, m."""

    position: tuple[float, float, float]
    radius: float
    rgba: tuple[float, float, float, float] = (1.0, 0.85, 0.1, 0.55)


def with_discs(draw_list: DrawList) -> tuple[NDArray[np.void], NDArray[np.int32]]:
    """Return a list's vertices and triangles, followed by a row with a disc for each highlight."""
    positions, normals, uv, triangles = disc()
    discs = np.zeros((HIGHLIGHTS, len(positions)), dtype=VERTEX)
    discs["position"], discs["normal"], discs["uv"] = positions, normals, uv
    discs["row"] = len(draw_list.materials) + np.arange(HIGHLIGHTS)[:, None]
    starts = len(draw_list.vertices) + len(positions) * np.arange(HIGHLIGHTS)[:, None, None]
    vertices = np.concatenate([draw_list.vertices, discs.ravel()])
    return vertices, np.concatenate([draw_list.triangles, (triangles + starts).reshape(-1, 3)]).astype(np.int32)


def table_of(draw_list: DrawList) -> Floats:
    """Return a table (rows, TABLE_LINES, 4) for the rows of a list and of highlights."""
    return np.zeros((len(draw_list.materials) + HIGHLIGHTS, TABLE_LINES, 4), dtype=np.float32)


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
    rows = len(draw_list.materials)
    draw_list.fill(table[:rows], model, data)
    for row, mark in zip(table[rows:], highlights, strict=False):
        row[:3] = np.diag([mark.radius, mark.radius, DISC_HALF_HEIGHT]) @ np.eye(3, 4)
        row[:3, 3] = mark.position
        row[3], row[4] = mark.rgba, _MATERIAL
