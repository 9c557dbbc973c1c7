"""Build bowls, plates, the frying pan and the moka pot.

The origin of bowls and plates is the centre of the bottom, below their content.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder, axis_angle_quaternion
from lerobot_memobench.sim.assets.meshes import MeshData, ball, lathe, merged, tube
from lerobot_memobench.sim.assets.paint import Canvas, Colour, Pixels, draw_texture

GLAZE = (0.4, 0.02, 0.0005)
"""Friction of a glazed foot."""


@dataclass(frozen=True)
class Bowl:
    """A bowl: radii of rim and foot outside, height, thickness of wall and floor [m], mass [kg], colours."""

    key: str
    rim: float
    foot: float
    height: float
    wall: float
    base: float
    mass: float
    outside: Colour
    inside: Colour
    lip: Colour

    def _wall(self, z: float) -> float:
        """Return the outer radius at height ``z``; the wall bulges slightly between foot and rim."""
        share = z / self.height
        return self.foot + (self.rim - self.foot) * (share + 0.25 * share * (1 - share))

    def mesh(self) -> MeshData:
        """Return the mesh: outside from the foot up, over the rim, and down the inside."""
        r, h, w = self.rim, self.height, self.wall
        outside = [(self._wall(share * h), share * h) for share in (0.1, 0.4, 0.7)]
        inside = [(self._wall(share * h) - w, share * h) for share in (0.7, 0.4)]
        floor = self._wall(self.base) - w
        return lathe(
            [
                (0.0, 0.0),
                (self.foot - 0.003, 0.0),
                *outside,
                (r, h - 0.001),
                (r - 0.5 * w, h),
                (r - w, h - 0.001),
                *inside,
                (floor, self.base + 0.002),
                (floor - 0.003, self.base),
                (0.0, self.base),
            ],
            segments=24,
            by_length=True,
        )

    def texture(self) -> Pixels:
        """Return bands from the centre of the inside (top of the image) to the centre of the outside."""

        def paint(canvas: Canvas) -> None:
            canvas.rect(0, 0, 1, 0.475, self.inside)
            canvas.rect(0, 0.455, 1, 0.495, self.lip)

        return draw_texture(16, 256, self.outside, paint)

    def build(self, b: Builder) -> Asset:
        """Add the bowl to the scene."""
        material = b.material(self.key, self.texture, specular=0.6, shininess=0.7)
        b.visual_mesh(b.mesh(self.key, self.mesh), material)
        b.collision("cylinder", (self.foot - 0.001, 0.5 * self.base), 0.5 * self.mass, (0, 0, 0.5 * self.base))
        middle, top = 0.5 * self.wall, self.height - 0.001
        low = (self._wall(self.base) - middle, 0.5 * self.base)
        b.ring(16, low, (self.rim - middle, top), self.wall, 0.5 * self.mass, GRIP_FRICTION)
        held = self.height - 0.008
        b.grasp((self._wall(held) - middle, 0.0, held), ALONG_X, self.wall + 0.003, symmetric=True)
        r, h = self.rim, self.height
        return b.object((-r, -r, 0), (r, r, h), round=True, floor=self.base, clear=self.foot - self.wall)


AKITA = Bowl(
    key="akita_black_bowl",
    rim=0.0535,
    foot=0.0430,
    height=0.051,
    wall=0.004,
    base=0.005,
    mass=0.10,
    outside=(38, 38, 42),
    inside=(58, 58, 64),
    lip=(120, 118, 116),
)
WHITE_BOWL = Bowl(
    key="white_bowl",
    rim=0.0405,
    foot=0.026,
    height=0.034,
    wall=0.004,
    base=0.005,
    mass=0.06,
    outside=(236, 236, 232),
    inside=(250, 250, 248),
    lip=(205, 208, 214),
)

_PLATE = 0.0687
_PLATE_FOOT = 0.042
_PLATE_FLOOR = 0.047
_PLATE_HIGH = 0.019


def _plate_mesh() -> MeshData:
    r, h = _PLATE, _PLATE_HIGH
    return lathe(
        [
            (0.0, 0.0),
            (_PLATE_FOOT, 0.0),
            (_PLATE_FOOT + 0.006, 0.004),
            (r, h - 0.002),
            (r - 0.001, h),
            (r - 0.004, h - 0.001),
            (_PLATE_FLOOR + 0.007, 0.0095),
            (_PLATE_FLOOR, 0.0055),
            (0.0, 0.005),
        ],
        segments=32,
        by_length=True,
    )


def _plate_texture() -> Pixels:
    # The profile is 14 cm long; the first half of the image is the inside, from its middle to the rim.
    blue: Colour = (52, 96, 160)

    def paint(canvas: Canvas) -> None:
        canvas.rect(0, 0.30, 1, 0.325, (214, 216, 220))
        canvas.rect(0, 0.425, 1, 0.455, blue)
        canvas.rect(0, 0.475, 1, 0.50, blue)
        canvas.rect(0, 0.53, 1, 1, (228, 228, 224))

    return draw_texture(16, 256, (246, 246, 243), paint)


def _plate(b: Builder) -> Asset:
    material = b.material("plate", _plate_texture, specular=0.5, shininess=0.7)
    b.visual_mesh(b.mesh("plate", _plate_mesh), material)
    mass = 0.18
    b.collision("cylinder", (_PLATE_FOOT + 0.003, 0.0025), 0.6 * mass, (0, 0, 0.0025), friction=GLAZE).priority = 1
    b.ring(
        16,
        (_PLATE_FLOOR - 0.002, 0.003),
        (_PLATE - 0.002, _PLATE_HIGH - 0.002),
        0.004,
        0.4 * mass,
        GRIP_FRICTION,
    )
    b.grasp((_PLATE - 0.006, 0.0, _PLATE_HIGH - 0.004), ALONG_X, 0.012, symmetric=True)
    r = _PLATE
    return b.object((-r, -r, 0), (r, r, _PLATE_HIGH), round=True, floor=0.005, clear=_PLATE_FLOOR)


# Frying pan: the disc's middle is the origin, the handle points to +y and rises.
_PAN = 0.102
_PAN_BASE = 0.078
_PAN_WALL = 0.043
_PAN_END = 0.254
_PAN_HIGH = 0.058


def _pan_mesh() -> MeshData:
    return lathe(
        [
            (0.0, 0.0),
            (_PAN_BASE, 0.0),
            (_PAN_BASE + 0.010, 0.008),
            (_PAN - 0.001, _PAN_WALL - 0.002),
            (_PAN, _PAN_WALL),
            (_PAN - 0.004, _PAN_WALL),
            (_PAN_BASE + 0.005, 0.012),
            (_PAN_BASE - 0.006, 0.0055),
            (0.0, 0.005),
        ],
        segments=28,
        by_length=True,
    )


def _pan_texture() -> Pixels:
    def paint(canvas: Canvas) -> None:
        canvas.rect(0, 0.00, 1, 0.31, (40, 41, 41))
        canvas.rect(0, 0.31, 1, 0.345, (92, 95, 95))
        canvas.rect(0, 0.345, 1, 0.49, (66, 69, 69))
        canvas.rect(0, 0.475, 1, 0.515, (150, 153, 155))
        canvas.rect(0, 0.515, 1, 1.0, (48, 50, 51))

    return draw_texture(16, 256, (48, 50, 51), paint)


def _handle_mesh() -> MeshData:
    path = [
        (0, 0.092, 0.036),
        (0, 0.108, 0.038),
        (0, 0.112, 0.039),
        (0, 0.150, 0.0445),
        (0, 0.200, 0.0495),
        (0, 0.240, 0.0510),
        (0, _PAN_END, 0.0505),
    ]
    radii = [
        (0.010, 0.004),
        (0.010, 0.004),
        (0.0105, 0.008),
        (0.0105, 0.007),
        (0.012, 0.007),
        (0.0125, 0.007),
    ]
    return tube(path, [*radii, (0.007, 0.004)], sides=8)


def _frypan(b: Builder) -> Asset:
    pan = b.material("frypan", _pan_texture, specular=0.6, shininess=0.5)
    grip = b.material("frypan_handle", rgba=(0.075, 0.075, 0.08, 1), specular=0.4, shininess=0.5)
    steel = b.material("steel", rgba=(0.72, 0.73, 0.75, 1), specular=0.8, shininess=0.7)
    b.visual_mesh(b.mesh("frypan", _pan_mesh), pan)
    b.visual_mesh(b.mesh("frypan_handle", _handle_mesh), grip)
    b.visual("box", (0.0055, 0.012, 0.0012), grip, (0, 0.228, 0.0572), axis_angle_quaternion((1, 0, 0), 0.02))
    b.visual("box", (0.0112, 0.011, 0.0048), steel, (0, 0.106, 0.0378), axis_angle_quaternion((1, 0, 0), 0.15))
    b.collision("cylinder", (_PAN_BASE, 0.0025), 0.13, (0, 0, 0.0025))
    b.ring(14, (_PAN_BASE + 0.002, 0.003), (_PAN - 0.002, _PAN_WALL - 0.001), 0.004, 0.04)
    for y0, z0, y1, z1 in ((0.098, 0.0375, 0.150, 0.0445), (0.150, 0.0445, _PAN_END, 0.0505)):
        slope = np.arctan2(z1 - z0, y1 - y0)
        half = 0.5 * np.hypot(y1 - y0, z1 - z0)
        b.collision(
            "box",
            (0.0105, half, 0.007),
            0.01,
            (0, (y0 + y1) / 2, (z0 + z1) / 2),
            axis_angle_quaternion((1, 0, 0), slope),
            friction=GRIP_FRICTION,
        )
    for y in (0.135, 0.165, 0.195):
        b.grasp((0.0, y, 0.0445 + 0.1 * (y - 0.15)), ALONG_X, 0.021)
    high = (_PAN, _PAN_END, _PAN_HIGH)
    return b.object((-_PAN, -_PAN, 0), high, floor=0.005, clear=_PAN_BASE - 0.006)


# Moka pot: eight-sided, the spout at +y, the handle at -y.
_MOKA_LOW = -0.076


def _moka_body() -> MeshData:
    z = _MOKA_LOW
    profile = [
        (0.0, z),
        (0.0400, z),
        (0.0405, z + 0.003),
        (0.0335, z + 0.058),
        (0.0340, z + 0.060),
        (0.0340, z + 0.068),
        (0.0300, z + 0.070),
        (0.0300, z + 0.074),
        (0.0325, z + 0.076),
        (0.0395, z + 0.122),
        (0.0395, z + 0.125),
        (0.0180, z + 0.136),
        (0.0, z + 0.138),
    ]
    # Two faces are perpendicular to x, so that the camera sees a facet and not an edge.
    return lathe(profile, segments=8).turned((0, 0, 1), np.pi / 8)


def _moka_spout() -> MeshData:
    z = _MOKA_LOW
    vertices = np.array(
        [
            (0.016, 0.034, z + 0.124),
            (-0.016, 0.034, z + 0.124),
            (0.003, 0.060, z + 0.128),
            (-0.003, 0.060, z + 0.128),
            (0.0, 0.031, z + 0.085),
        ]
    )
    faces = np.array([(0, 2, 3), (0, 3, 1), (0, 4, 2), (2, 4, 3), (1, 3, 4)])
    return MeshData(vertices, faces)


def _moka_black() -> MeshData:
    z = _MOKA_LOW
    handle = tube(
        [
            (0, -0.034, z + 0.121),
            (0, -0.060, z + 0.126),
            (0, -0.075, z + 0.118),
            (0, -0.080, z + 0.095),
            (0, -0.084, z + 0.060),
        ],
        [(0.009, 0.006), (0.009, 0.006), (0.009, 0.006), (0.009, 0.005), (0.007, 0.004)],
        sides=6,
        up=(0, 0.6, 0.8),
    )
    knob = ball((0.009, 0.009, 0.008), 8, 5).moved((0, 0, z + 0.144))
    return merged(handle, knob.without_uv())


def _moka_pot(b: Builder) -> Asset:
    aluminium = b.material("moka_aluminium", rgba=(0.80, 0.81, 0.83, 1), specular=0.9, shininess=0.6)
    black = b.material("moka_black", rgba=(0.06, 0.06, 0.065, 1), specular=0.5, shininess=0.5)
    b.visual_mesh(b.mesh("moka_body", _moka_body), aluminium)
    b.visual_mesh(b.mesh("moka_spout", _moka_spout), aluminium)
    b.visual_mesh(b.mesh("moka_black", _moka_black), black)
    z = _MOKA_LOW
    b.collision("cylinder", (0.0385, 0.030), 0.14, (0, 0, z + 0.030))
    b.collision("cylinder", (0.032, 0.008), 0.02, (0, 0, z + 0.068))
    b.collision("cylinder", (0.0365, 0.030), 0.06, (0, 0, z + 0.106))
    b.collision("box", (0.009, 0.006, 0.030), 0.01, (0, -0.080, z + 0.091), friction=GRIP_FRICTION)
    b.collision("box", (0.009, 0.022, 0.006), 0.005, (0, -0.055, z + 0.123), friction=GRIP_FRICTION)
    b.collision("cylinder", (0.009, 0.008), 0.005, (0, 0, z + 0.144), friction=GRIP_FRICTION)
    b.grasp((0.0, -0.080, z + 0.110), ALONG_X, 0.018)
    b.grasp((0.0, 0.0, z + 0.144), ALONG_X, 0.018)
    return b.object((-0.0405, -0.087, z), (0.0405, 0.061, z + 0.152))


BUILDERS: dict[str, Callable[[Builder], Asset]] = {
    "akita_black_bowl": AKITA.build,
    "white_bowl": WHITE_BOWL.build,
    "plate": _plate,
    "chefmate_8_frypan": _frypan,
    "moka_pot": _moka_pot,
}
