"""Build small objects: a phone charger, a bottle cap and a cork."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Block, Floats, MeshData, blocks, box, lathe, tube
from lerobot_memobench.sim.assets.paint import Canvas, Colour, Pixels, atlas, draw_texture

# Charger: a plug lying on its back, prongs to -x, the port to +x, with a coiled cable on top.
_CHARGER = (0.024, 0.021, 0.019)  # half sizes of the plug


def _charger_texture() -> Pixels:
    white: Colour = (246, 246, 246)

    def port(canvas: Canvas) -> None:
        canvas.rect(0.28, 0.38, 0.72, 0.62, (60, 62, 66))
        canvas.rect(0.33, 0.47, 0.67, 0.53, (210, 214, 220))

    def bolt(canvas: Canvas) -> None:
        canvas.rect(0.06, 0.06, 0.94, 0.94, (232, 234, 238))
        canvas.shape((40, 150, 70), 0.60, 0.12, 0.28, 0.56, 0.48, 0.56, 0.40, 0.88, 0.72, 0.44, 0.52, 0.44)

    return atlas({"+x": draw_texture(64, 64, white, port), "+z": draw_texture(96, 96, white, bolt)}, white)


def _prongs() -> MeshData:
    x = _CHARGER[0]
    return blocks([Block((-x - 0.0085, s * 0.0075, 0), (0.0085, 0.0012, 0.0035), 0) for s in (-1.0, 1.0)])


def _cable() -> MeshData:
    """Return a cable that runs from the port down to the table and curls next to the plug."""
    x, _, z = _CHARGER
    path = [
        (x - 0.002, 0.0, 0.0),
        (x + 0.008, 0.0, -0.002),
        (x + 0.016, 0.0, -0.010),
        (x + 0.021, 0.003, -z + 0.003),
        (x + 0.020, 0.014, -z + 0.0025),
        (x + 0.008, 0.026, -z + 0.0025),
        (x - 0.014, 0.030, -z + 0.0025),
        (x - 0.038, 0.029, -z + 0.0025),
    ]
    return tube(path, [0.0040, 0.0040, 0.0030, 0.0025, 0.0025, 0.0025, 0.0025, 0.0035], sides=6, up=(0.1, 0.2, 1))


def _charger(b: Builder) -> Asset:
    x, y, z = _CHARGER
    body = b.material("charger", _charger_texture, specular=0.5, shininess=0.6)
    metal = b.material("steel", rgba=(0.72, 0.73, 0.75, 1), specular=0.8, shininess=0.7)
    dark = b.material("charger_cable", rgba=(0.16, 0.16, 0.17, 1), specular=0.3)
    b.visual_mesh(b.mesh("charger", lambda: box(_CHARGER)), body)
    b.visual_mesh(b.mesh("charger_prongs", _prongs), metal)
    b.visual_mesh(b.mesh("charger_cable", _cable, smooth=True), dark)
    b.collision("box", _CHARGER, 0.06, friction=GRIP_FRICTION)
    b.collision("box", (0.0085, 0.0087, 0.0035), 0.004, (-x - 0.0085, 0, 0))
    b.grasp((0, 0, 0), ALONG_Y, 2 * y)
    # Lengthwise grasp for a hand that must not close towards a drawer.
    b.grasp((-0.0085, 0, 0), ALONG_X, 2 * x + 0.017)
    return b.object((-x - 0.017, -y, -z), (x + 0.0235, y + 0.0125, z))


# Cap: the screw cap of a bottle (WordNet sense cap.n.02, as in the data set of the scans).
_CAP = (0.0260, 0.0150)  # radius and half height


def _cap_mesh() -> MeshData:
    radius, half = _CAP
    ribs = 18

    def rib(points: Floats) -> Floats:
        angle = np.arctan2(points[:, 1], points[:, 0])
        side = (points[:, 2] < 0.8 * half) & (points[:, 2] > -0.75 * half)
        points[side, :2] *= (1 - 0.055 * (np.round(angle[side] / (np.pi / ribs)).astype(int) % 2))[:, None]
        return points

    profile = [(0.0, -half), (radius, -half), (radius, -0.78 * half), (0.985 * radius, -0.70 * half)]
    profile += [(0.985 * radius, 0.72 * half), (0.90 * radius, half), (0.0, half)]
    return lathe(profile, 2 * ribs, by_length=True).warped(rib)


def _cap_texture() -> Pixels:
    blue: Colour = (22, 92, 200)

    def paint(canvas: Canvas) -> None:
        canvas.rect(0, 0.16, 1, 0.22, (240, 244, 250))
        for k in range(36):
            canvas.rect(k / 36 - 0.007, 0.31, k / 36 + 0.007, 0.62, (14, 62, 150))
        canvas.rect(0, 0.64, 1, 0.70, (240, 244, 250))

    return draw_texture(288, 96, blue, paint)


def _cap(b: Builder) -> Asset:
    radius, half = _CAP
    b.textured_mesh("cap", _cap_mesh, _cap_texture, specular=0.5, shininess=0.5)
    b.collision("cylinder", (radius, half), 0.03, friction=GRIP_FRICTION)
    b.grasp((0, 0, 0), ALONG_X, 2 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


# Cork: a wine cork standing on its end, larger than life so that it can be seen and held.
_CORK = (0.0190, 0.0165, 0.0255)  # radius at the top and bottom, half height


def _cork_texture() -> Pixels:
    """Return cork with dark pores, printed with a bunch of grapes, its foot stained by wine."""
    rng = np.random.default_rng(31)
    canvas = Canvas(256, 128, (214, 170, 118))
    for _ in range(200):
        x, y, size = rng.uniform(0, 1), rng.uniform(0, 1), rng.uniform(0.003, 0.012)
        shade = int(rng.integers(120, 170))
        canvas.oval(x, y, x + size, y + 2.0 * size, (shade, int(0.72 * shade), int(0.45 * shade)))
    canvas.rect(0, 0.72, 1, 0.80, (150, 66, 78))
    canvas.rect(0, 0.80, 1, 1, (112, 34, 54))
    grape: Colour = (96, 24, 60)
    for row, count in enumerate((4, 3, 2, 1)):
        for k in range(count):
            x, y = 0.5 + 0.045 * (k - (count - 1) / 2), 0.36 + 0.08 * row
            canvas.oval(x - 0.02, y - 0.036, x + 0.02, y + 0.036, grape)
    canvas.line((70, 90, 40), 0.01, 0.5, 0.33, 0.52, 0.27)
    return canvas.pixels()


def _cork_mesh() -> MeshData:
    top, bottom, half = _CORK
    profile = [(0.0, -half), (bottom - 0.001, -half), (bottom, -half + 0.001), (top, half - 0.0015)]
    return lathe([*profile, (top - 0.0015, half), (0.0, half)], 20, by_length=True)


def _cork(b: Builder) -> Asset:
    top, bottom, half = _CORK
    b.textured_mesh("cork", _cork_mesh, _cork_texture, specular=0.05, shininess=0.1)
    b.collision("cylinder", (bottom, half), 0.015, friction=GRIP_FRICTION)
    b.grasp((0, 0, 0.004), ALONG_X, 2 * bottom, symmetric=True)
    return b.object((-top, -top, -half), (top, top, half), round=True)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"charger": _charger, "cap": _cap, "cork": _cork}
