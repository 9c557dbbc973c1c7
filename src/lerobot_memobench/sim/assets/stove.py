"""A flat stove with one burner and a knob, as the published scenes have it.

The knob's axis is the origin: it stands on the robot's side, the burner plate on the camera's. At q = 0 (off)
the knob's ridge runs along the fixture's x axis; turning it on turns the ridge counter-clockwise from above.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.sim.assets.asset import Articulation, Asset, Handle
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Floats, MeshData, Quad, box, cell_uv, lathe, quads_mesh
from lerobot_memobench.sim.assets.paint import Canvas, Pixels, drawn, speckle

_PLATE = (0.062, 0.250)  # from x to x
_HALF_WIDTH = 0.095
_TOP = 0.026
_BURNER = 0.156  # x of the burner's middle
_BURNER_RADIUS = 0.068
_BURNER_TOP = 0.030
_KNOB_RADIUS = 0.044
_KNOB_BASE = 0.020
_RIDGE = (0.030, 0.0085)  # half length and half thickness
_RIDGE_TOP = 0.070
BUTTON_RANGE = (-0.005, 2.1)


def _plate_mesh() -> MeshData:
    """Return a box with a bevelled edge towards the camera."""
    x0, x1 = _PLATE
    y, z, bevel = _HALF_WIDTH, _TOP, 0.028
    front_z = 0.014

    quads: list[Quad] = [
        [(x0, -y, z), (x1 - bevel, -y, z), (x1 - bevel, y, z), (x0, y, z)],
        [(x1 - bevel, -y, z), (x1, -y, front_z), (x1, y, front_z), (x1 - bevel, y, z)],
        [(x1, -y, 0), (x1, y, 0), (x1, y, front_z), (x1, -y, front_z)],
        [(x0, y, 0), (x0, -y, 0), (x0, -y, z), (x0, y, z)],
        [(x0, -y, 0), (x1, -y, 0), (x1, -y, front_z), (x0, -y, z)],
        [(x1, y, 0), (x0, y, 0), (x0, y, z), (x1, y, front_z)],
        [(x1 - bevel, -y, z), (x0, -y, z), (x1, -y, front_z), (x1, -y, front_z)],
        [(x0, y, z), (x1 - bevel, y, z), (x1, y, front_z), (x1, y, front_z)],
    ]
    return quads_mesh(quads, [cell_uv(0, 0, 1, 1)] * len(quads))


def _disc_mesh() -> MeshData:
    r, low = _BURNER_RADIUS, _TOP
    profile = [(r + 0.003, low), (r, _BURNER_TOP - 0.001), (r - 0.002, _BURNER_TOP), (0.0, _BURNER_TOP)]
    return lathe(profile, 24, by_length=True).moved((_BURNER, 0, 0))


def _coil_texture() -> Pixels:
    """Return a spiral in polar coordinates, around by radius: the coil bright, the gaps dark."""
    high, wide = 128, 128
    v, u = np.mgrid[0:high, 0:wide] / np.array([high, wide])[:, None, None]
    turn = (4.6 * v + u) % 1.0
    bright = np.where((turn > 0.26) & (v > 0.08) & (v < 0.90), 1.0, 0.42)
    return np.repeat((255 * bright).astype(np.uint8)[..., None], 3, axis=2)


def _knob_mesh() -> MeshData:
    r, h = _KNOB_RADIUS, _KNOB_BASE
    return lathe([(r, 0.0), (r, 0.5 * h), (r - 0.004, h - 0.002), (r - 0.010, h), (0.0, h + 0.001)], segments=20)


def _ridge_mesh() -> MeshData:
    half = 0.5 * (_RIDGE_TOP - _KNOB_BASE) + 0.002

    def taper(points: Floats) -> Floats:
        up = points[:, 2] > 0
        points[up, 0] *= 0.90
        points[up, 1] *= 0.92
        return points

    return box((*_RIDGE, half)).warped(taper).moved((0, 0, _RIDGE_TOP - half))


def _mark(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 1, (24, 24, 26))
    # The top face (row 0, column 2) has a white line towards +x, the pointer.
    canvas.rect(2 / 3 + 0.13, 0.25, 2 / 3 + 0.2, 0.5, (235, 235, 235))


def _ridge_texture() -> Pixels:
    return drawn(96, 64, (24, 24, 26), _mark)


def _stove(b: Builder) -> Asset:
    steel = b.material(
        "stove_steel", lambda: speckle((196, 194, 184), 6, seed=3, along=0.02), specular=0.7, shininess=0.6
    )
    coil = b.material("stove_coil", _coil_texture, specular=0.2, shininess=0.2, emission=0.3)
    black = b.material("stove_black", rgba=(0.10, 0.10, 0.11, 1), specular=0.5, shininess=0.5)
    ridge = b.material("stove_ridge", _ridge_texture, specular=0.5, shininess=0.5)
    b.visual_mesh(b.mesh("stove_plate", _plate_mesh), steel)
    glowing = b.visual_mesh(b.mesh("stove_coil", _disc_mesh), coil)

    x0, x1 = _PLATE
    b.collision("box", ((x1 - x0) / 2, _HALF_WIDTH, _TOP / 2), 3.5, ((x0 + x1) / 2, 0, _TOP / 2))
    half = 0.5 * (_BURNER_TOP - _TOP)
    b.collision("cylinder", (_BURNER_RADIUS, half), 0.3, (_BURNER, 0, _TOP + half))
    articulation = _knob(b, black, ridge)
    cook = b.site("cook_region", (_BURNER, 0, _BURNER_TOP - 0.001), (0.085, 0.085, 0.001), box=True)
    asset = b.fixture(
        low=(-_KNOB_RADIUS, -_HALF_WIDTH, 0),
        high=(x1, _HALF_WIDTH, _RIDGE_TOP),
        regions={"cook_region": cook},
        articulations={"": articulation},
        supports=_BURNER_TOP,
        clear=_BURNER_RADIUS,
        glow=(glowing.name,),
    )
    glowing.rgba = list(asset.glow_off)
    return asset


def _knob(b: Builder, black: str, ridge: str) -> Articulation:
    """Add the knob with its joint."""
    knob = b.child("knob")
    joint = b.joint(knob, "button", "hinge", (0, 0, 1), BUTTON_RANGE, damping=0.2, frictionloss=0.05)
    b.visual_mesh(b.mesh("stove_knob", _knob_mesh), black, body=knob)
    b.visual_mesh(b.mesh("stove_ridge", _ridge_mesh), ridge, body=knob)
    b.collision("cylinder", (_KNOB_RADIUS, _KNOB_BASE / 2 - 0.0005), 0.1, (0, 0, _KNOB_BASE / 2 + 0.0005), body=knob)
    rise = 0.5 * (_RIDGE_TOP - _KNOB_BASE)
    b.collision("box", (*_RIDGE, rise), 0.05, (0, 0, _KNOB_BASE + rise), body=knob, friction=GRIP_FRICTION)
    return Articulation(
        joint=joint,
        kind="knob",
        closed_q=BUTTON_RANGE[0],
        open_q=1.0,
        handle_site=b.site("button_handle", (0, 0, _RIDGE_TOP - 0.02), body=knob),
        handle=Handle(2 * _RIDGE[0], (2 * _RIDGE[1], _RIDGE_TOP - _KNOB_BASE), 0.03),
        on_at_least=0.5,
        off_below=0.0,
    )


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"flat_stove": _stove}
