"""Cartons of milk with a gable top."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Floats, Half, MeshData, Quad, cell_uv, quads_mesh
from lerobot_memobench.sim.assets.paint import BLACK, WHITE, Canvas, Colour, Pixels, drawn, wrapped


def _carton_mesh(half: Half, shoulder: float, fin: float = 0.009) -> MeshData:
    """Return a gable-top carton: atlas cells as for a box, the slopes take the tops of front and back."""
    x, y, z = half
    base, ridge, thin = z - shoulder, z - fin, 0.0022
    # Half depth at each height, and which part of the front's image lies below it.
    outline = [(x, -z, 0.0), (x, base, (base + z) / (2 * z)), (thin, ridge, (ridge + z) / (2 * z)), (thin, z, 1.0)]
    quads: list[Quad] = []
    uvs: list[Floats] = []
    for row, s in enumerate((1.0, -1.0)):
        for (x0, z0, _), (x1, z1, _) in pairwise(outline):
            quads.append([(s * x0, -s * y, z0), (s * x0, s * y, z0), (s * x1, s * y, z1), (s * x1, -s * y, z1)])
        for (x0, z0, _), (x1, z1, _) in pairwise(outline):
            quads.append([(s * x0, s * y, z0), (-s * x0, s * y, z0), (-s * x1, s * y, z1), (s * x1, s * y, z1)])
        for column in (0, 1):
            uvs += [_part_of_cell(column, row, low, high) for (_, _, low), (_, _, high) in pairwise(outline)]
    quads += [
        [(thin, -y, z), (thin, y, z), (-thin, y, z), (-thin, -y, z)],
        [(-x, -y, -z), (-x, y, -z), (x, y, -z), (x, -y, -z)],
    ]
    uvs += [cell_uv(2, 0), cell_uv(2, 1)]
    return quads_mesh(quads, uvs)


def _part_of_cell(column: int, row: int, low: float, high: float) -> Floats:
    """Cut a cell's uv to heights from ``low`` to ``high``, both 0 at the bottom and 1 at the top."""
    uv = cell_uv(column, row)
    bottom, top = uv[0, 1], uv[2, 1]
    uv[:2, 1], uv[2:, 1] = bottom + low * (top - bottom), bottom + high * (top - bottom)
    return uv


def _carton(
    b: Builder, key: str, half: Half, texture: Callable[[], Pixels], mass: float, shoulder: float = 0.032
) -> Asset:
    b.visual_mesh(
        b.mesh(key, lambda: _carton_mesh(half, shoulder)), b.material(key, texture, specular=0.25, shininess=0.4)
    )
    x, y, z = half
    base = z - shoulder
    b.collision("box", (x, y, (base + z) / 2), 0.9 * mass, (0, 0, (base - z) / 2), friction=GRIP_FRICTION)
    b.collision("box", (0.35 * x, y, shoulder / 2), 0.1 * mass, (0, 0, z - shoulder / 2), friction=GRIP_FRICTION)
    at = z - 0.0325  # the palm all but touches the fin
    b.grasp((0, 0, at), ALONG_X, 2 * x, depth=0.03)
    b.grasp((0, 0, at), ALONG_Y, 2 * y, depth=0.03)
    return b.object((-x, -y, -z), half)


def _splash(canvas: Canvas, colour: Colour, level: float) -> None:
    """Paint a wave of milk over the lower part."""
    points = []
    for k in range(41):
        x = k / 40
        points += [x, level + 0.035 * np.sin(2 * np.pi * 1.5 * x) + 0.012 * np.sin(2 * np.pi * 4 * x)]
    canvas.shape(colour, *points, 1, 1, 0, 1)


def _milk_texture() -> Pixels:
    red: Colour = (206, 38, 34)
    blue: Colour = (38, 92, 176)

    def front(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.26, (176, 28, 26))
        canvas.text("MILK", 0.06, 0.29, 0.94, 0.55, WHITE)
        _splash(canvas, WHITE, 0.66)
        canvas.text("1 L", 0.30, 0.82, 0.70, 0.96, blue)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.26, (176, 28, 26))
        _splash(canvas, WHITE, 0.66)
        for k in range(5):
            canvas.rect(0.15, 0.34 + 0.055 * k, 0.85, 0.36 + 0.055 * k, (240, 190, 186))

    return wrapped(drawn(128, 256, red, front), drawn(128, 256, red, side), drawn(16, 16, red), red)


def _milk(b: Builder) -> Asset:
    return _carton(b, "milk", (0.0265, 0.0270, 0.0655), _milk_texture, 0.15)


def _cow(canvas: Canvas) -> None:
    canvas.oval(0.25, 0.62, 0.75, 0.84, WHITE)
    canvas.oval(0.62, 0.55, 0.88, 0.74, WHITE)
    canvas.oval(0.33, 0.64, 0.48, 0.75, BLACK)
    canvas.oval(0.55, 0.70, 0.66, 0.80, BLACK)
    canvas.oval(0.80, 0.62, 0.90, 0.72, (240, 170, 170))
    for x in (0.32, 0.42, 0.60, 0.68):
        canvas.rect(x, 0.80, x + 0.05, 0.92, WHITE)


def _carton_of_milk_texture() -> Pixels:
    sky: Colour = (86, 164, 222)
    navy: Colour = (22, 58, 130)

    def front(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.22, navy)
        canvas.text("MILK", 0.06, 0.25, 0.94, 0.50, navy)
        canvas.rect(0, 0.88, 1, 1, (96, 170, 74))
        _cow(canvas)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.22, navy)
        canvas.rect(0, 0.88, 1, 1, (96, 170, 74))
        canvas.text("MILK", 0.36, 0.28, 0.64, 0.84, navy, turn=1)

    return wrapped(drawn(128, 256, (226, 240, 250), front), drawn(128, 256, sky, side), drawn(16, 16, navy), navy)


def _carton_of_milk(b: Builder) -> Asset:
    return _carton(b, "carton_of_milk", (0.0310, 0.0310, 0.0790), _carton_of_milk_texture, 0.20, 0.036)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"milk": _milk, "carton_of_milk": _carton_of_milk}
