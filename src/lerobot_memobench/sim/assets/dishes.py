"""Bowls and plates. Their origin is the centre of the bottom, so that things put into them lie above it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lerobot_memobench.sim.assets.asset import ALONG_X, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import MeshData, lathe
from lerobot_memobench.sim.assets.paint import Canvas, Colour, Pixels, drawn

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
        """Return the outer radius at height ``z``: a wall that bulges a little between foot and rim."""
        share = z / self.height
        return self.foot + (self.rim - self.foot) * (share + 0.25 * share * (1 - share))

    def mesh(self) -> MeshData:
        """Return outside from the foot up, over the rim and down the inside."""
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
        """Return bands from the inside's middle (top of the image) to the outside's middle."""

        def paint(canvas: Canvas) -> None:
            canvas.rect(0, 0, 1, 0.475, self.inside)
            canvas.rect(0, 0.455, 1, 0.495, self.lip)

        return drawn(16, 256, self.outside, paint)

    def build(self, b: Builder) -> Asset:
        """Add the bowl to the scene."""
        material = b.material(self.key, self.texture, specular=0.6, shininess=0.7)
        b.visual_mesh(b.mesh(self.key, self.mesh), material)
        b.collision("cylinder", (self.foot - 0.001, 0.5 * self.base), 0.5 * self.mass, (0, 0, 0.5 * self.base))
        middle, top = 0.5 * self.wall, self.height - 0.001
        low = (self._wall(self.base) - middle, 0.5 * self.base)
        b.ring(16, low, (self.rim - middle, top), self.wall, 0.5 * self.mass, GRIP_FRICTION)
        held = self.height - 0.008
        b.grasp((self._wall(held) - middle, 0.0, held), ALONG_X, self.wall + 0.003, symmetric=True, depth=0.015)
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

    return drawn(16, 256, (246, 246, 243), paint)


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
    b.grasp((_PLATE - 0.006, 0.0, _PLATE_HIGH - 0.004), ALONG_X, 0.012, symmetric=True, depth=0.004)
    r = _PLATE
    return b.object((-r, -r, 0), (r, r, _PLATE_HIGH), round=True, floor=0.005, clear=_PLATE_FLOOR)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {
    "akita_black_bowl": AKITA.build,
    "white_bowl": WHITE_BOWL.build,
    "plate": _plate,
}
