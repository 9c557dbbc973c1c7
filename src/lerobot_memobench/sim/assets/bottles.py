"""Build bottles and tubs: surfaces of revolution, some flattened, with a label towards +x."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import MeshData, lathe
from lerobot_memobench.sim.assets.paint import BLACK, WHITE, Canvas, Colour, Drawing, Pixels, draw_texture


@dataclass(frozen=True)
class Bottle:
    """A bottle with its bottom at z = 0 before centring.

    ``profile``: (radius, z) from the bottom up [m]; ``scale``: factors of the radius along x and y.
    ``shoulder``: height of the body; ``neck``: radius above the body [m].
    ``paint`` draws the front view of the bottle.
    """

    key: str
    profile: tuple[tuple[float, float], ...]
    colour: Colour
    paint: Drawing
    mass: float
    shoulder: float
    neck: float
    scale: tuple[float, float] = (1.0, 1.0)
    gloss: float = 0.6

    def build(self, b: Builder) -> Asset:
        """Add the bottle to the scene."""
        high = self.profile[-1][1]
        b.textured_mesh(self.key, self._mesh, self.texture, self.gloss, 0.6)
        radius = max(r for r, _ in self.profile)
        x, y = radius * self.scale[0], radius * self.scale[1]
        self._contacts(b, x, y, high)
        self._grasps(b, x, y, high)
        return b.object((-x, -y, -high / 2), (x, y, high / 2), round=self._is_round)

    @property
    def _is_round(self) -> bool:
        return self.scale[0] == self.scale[1]

    def _mesh(self) -> MeshData:
        high = self.profile[-1][1]
        closed = ((0.0, self.profile[0][1]), *self.profile, (0.0, high))
        return lathe(closed, 20, scale=self.scale).moved((0, 0, -high / 2))

    def _contacts(self, b: Builder, x: float, y: float, high: float) -> None:
        middle = high / 2
        body = (0, 0, self.shoulder / 2 - middle)
        if self._is_round:
            b.collision("cylinder", (x, self.shoulder / 2), 0.9 * self.mass, body, friction=GRIP_FRICTION)
        else:
            # Two crossed boxes approximate an ellipse better than its bounding box.
            b.collision("box", (x, 0.72 * y, self.shoulder / 2), 0.5 * self.mass, body, friction=GRIP_FRICTION)
            b.collision("box", (0.72 * x, y, self.shoulder / 2), 0.4 * self.mass, body, friction=GRIP_FRICTION)
        rest = (high - self.shoulder) / 2
        if rest > 0:
            cap = (0, 0, high - rest - middle)
            b.collision("cylinder", (self.neck, rest), 0.1 * self.mass, cap, friction=GRIP_FRICTION)

    def _grasps(self, b: Builder, x: float, y: float, high: float) -> None:
        """Add grasps of the body if the fingers reach it from above, else of the neck or cap."""
        middle = high / 2
        reach = high - 0.036
        at = min(reach, self.shoulder - 0.010)
        if high - at > 0.042:
            # The body is below the fingers' reach.
            b.grasp((0, 0, high - 0.022 - middle), ALONG_X, 2 * self.neck, symmetric=True)
        elif self._is_round and 2 * x <= 0.068:
            b.grasp((0, 0, at - middle), ALONG_X, 2 * x, symmetric=True)
        else:
            for yaw, width in ((ALONG_X, 2 * x), (ALONG_Y, 2 * y)):
                if width <= 0.068:
                    b.grasp((0, 0, at - middle), yaw, width)

    def texture(self) -> Pixels:
        """Return the front image wrapped around the bottle, undistorted from +x and -x."""
        flat = draw_texture(160, 256, self.colour, self.paint)
        angles = 2 * np.pi * ((np.arange(256) + 0.5) / 256 - 0.5)
        seen = np.sin(angles) * np.where(np.cos(angles) < 0, -1.0, 1.0)
        return flat[:, np.clip((0.5 + 0.5 * seen) * 160, 0, 159).astype(int)]


# Ketchup and barbecue sauce --------------------------------------------------------------------
def _ketchup(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.19, WHITE)
    canvas.rect(0, 0.165, 1, 0.19, (205, 205, 205))
    canvas.oval(0.120, 0.36, 0.880, 0.92, WHITE)
    canvas.text("KETCHUP", 0.149, 0.50, 0.851, 0.63, (170, 20, 16))
    canvas.oval(0.348, 0.67, 0.652, 0.85, (206, 32, 24))
    canvas.shape((52, 130, 50), 0.386, 0.66, 0.5, 0.70, 0.614, 0.66, 0.5, 0.72)


KETCHUP = Bottle(
    key="ketchup",
    profile=(
        (0.0250, 0.0),
        (0.0275, 0.003),
        (0.0280, 0.060),
        (0.0255, 0.090),
        (0.0190, 0.108),
        (0.0135, 0.116),
        (0.0150, 0.118),
        (0.0140, 0.136),
        (0.0070, 0.138),
        (0.0055, 0.146),
    ),
    colour=(196, 26, 20),
    paint=_ketchup,
    mass=0.16,
    shoulder=0.100,
    neck=0.0145,
    scale=(0.66, 1.0),
)


def _bbq(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.19, (228, 178, 40))
    canvas.rect(0.101, 0.40, 0.899, 0.92, (240, 200, 70))
    canvas.rect(0.139, 0.42, 0.861, 0.66, (160, 24, 16))
    canvas.text("BBQ", 0.177, 0.44, 0.823, 0.64, WHITE)
    for x in (0.29, 0.5, 0.71):
        canvas.shape((214, 70, 20), x - 0.09, 0.90, x - 0.06, 0.78, x, 0.69, x + 0.06, 0.78, x + 0.09, 0.90)


BBQ = Bottle(
    key="bbq_sauce",
    profile=(
        (0.0215, 0.0),
        (0.0235, 0.002),
        (0.0235, 0.058),
        (0.0190, 0.072),
        (0.0105, 0.084),
        (0.0100, 0.089),
        (0.0125, 0.090),
        (0.0120, 0.107),
    ),
    colour=(70, 24, 12),
    paint=_bbq,
    mass=0.10,
    shoulder=0.068,
    neck=0.0122,
    scale=(0.62, 1.0),
)


# Household -------------------------------------------------------------------------------------
def _detergent(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.185, (24, 70, 180))
    canvas.oval(0.101, 0.40, 0.899, 0.96, (252, 214, 50))
    canvas.oval(0.177, 0.45, 0.823, 0.91, WHITE)
    canvas.text("DETER-\nGENT", 0.215, 0.53, 0.785, 0.76, (24, 60, 170))
    for x, y, r in ((0.37, 0.81, 0.055), (0.5, 0.83, 0.065), (0.63, 0.80, 0.05)):
        canvas.oval(x - r, y - 0.6 * r, x + r, y + 0.6 * r, (120, 190, 240))


DETERGENT = Bottle(
    key="bottle_of_detergent",
    profile=(
        (0.0400, 0.0),
        (0.0440, 0.004),
        (0.0440, 0.060),
        (0.0400, 0.090),
        (0.0280, 0.112),
        (0.0200, 0.119),
        (0.0200, 0.122),
        (0.0235, 0.123),
        (0.0215, 0.150),
    ),
    colour=(236, 96, 24),
    paint=_detergent,
    mass=0.22,
    shoulder=0.110,
    neck=0.0230,
    scale=(0.66, 1.0),
)


def _softener(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.22, (250, 250, 252))
    canvas.rect(0, 0.20, 1, 0.22, (200, 200, 214))
    canvas.rect(0.101, 0.40, 0.899, 0.58, (94, 60, 160))
    canvas.text("SOFTENER", 0.120, 0.42, 0.880, 0.56, WHITE)
    for k in range(6):
        a = 2 * np.pi * k / 6
        cx, cy = 0.623 * np.cos(a), 0.77 + 0.085 * np.sin(a)
        canvas.oval(cx - 0.075, cy - 0.05, cx + 0.075, cy + 0.05, WHITE)
    canvas.oval(0.43, 0.72, 0.57, 0.82, (250, 206, 60))


SOFTENER = Bottle(
    key="bottle_of_fabric_softener",
    profile=(
        (0.0330, 0.0),
        (0.0360, 0.004),
        (0.0375, 0.040),
        (0.0325, 0.070),
        (0.0335, 0.090),
        (0.0280, 0.112),
        (0.0215, 0.121),
        (0.0245, 0.122),
        (0.0245, 0.148),
        (0.0225, 0.156),
    ),
    colour=(238, 138, 182),
    paint=_softener,
    mass=0.22,
    shoulder=0.112,
    neck=0.0245,
    scale=(0.72, 1.0),
)


# Food ------------------------------------------------------------------------------------------
def _coffee(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.17, BLACK)
    canvas.rect(0.025, 0.46, 0.975, 0.90, (240, 226, 198))
    canvas.text("COFFEE", 0.120, 0.48, 0.880, 0.63, (70, 36, 16))
    canvas.oval(0.358, 0.65, 0.642, 0.88, (96, 52, 24))
    canvas.line((240, 226, 198), 0.014, 0.472, 0.66, 0.538, 0.73, 0.462, 0.80, 0.528, 0.87)


COFFEE = Bottle(
    key="bottle_of_coffee",
    profile=(
        (0.0270, 0.0),
        (0.0290, 0.003),
        (0.0290, 0.082),
        (0.0250, 0.095),
        (0.0180, 0.106),
        (0.0165, 0.116),
        (0.0195, 0.117),
        (0.0190, 0.138),
    ),
    colour=(84, 48, 26),
    paint=_coffee,
    mass=0.20,
    shoulder=0.092,
    neck=0.0192,
)


def _protein(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.22, (24, 24, 26))
    for k in range(20):
        canvas.rect(k / 20, 0.03, k / 20 + 0.02, 0.20, (56, 56, 60))
    canvas.rect(0, 0.80, 1, 0.86, (214, 36, 36))
    canvas.rect(0.063, 0.28, 0.937, 0.54, (214, 36, 36))
    canvas.text("PROTEIN", 0.120, 0.31, 0.880, 0.51, WHITE)
    canvas.text("POWDER", 0.215, 0.60, 0.785, 0.75, WHITE)


PROTEIN = Bottle(
    key="bottle_of_protein_powder",
    profile=(
        (0.0310, 0.0),
        (0.0330, 0.003),
        (0.0330, 0.086),
        (0.0290, 0.092),
        (0.0320, 0.093),
        (0.0320, 0.117),
        (0.0305, 0.119),
    ),
    colour=(60, 60, 66),
    paint=_protein,
    mass=0.20,
    shoulder=0.119,
    neck=0.0320,
    gloss=0.4,
)


def _olive_oil(canvas: Canvas) -> None:
    canvas.rect(0, 0, 1, 0.18, (196, 160, 60))
    canvas.rect(0, 0.18, 1, 0.38, (92, 110, 24))
    canvas.rect(0.044, 0.50, 0.956, 0.92, (246, 240, 216))
    canvas.text("OLIVE\nOIL", 0.139, 0.515, 0.861, 0.74, (60, 84, 20))
    canvas.oval(0.291, 0.76, 0.481, 0.88, (86, 112, 30))
    canvas.oval(0.519, 0.78, 0.709, 0.90, (40, 46, 30))


OLIVE_OIL = Bottle(
    key="bottle_of_olive_oil",
    profile=(
        (0.0255, 0.0),
        (0.0270, 0.003),
        (0.0270, 0.094),
        (0.0240, 0.106),
        (0.0140, 0.120),
        (0.0115, 0.128),
        (0.0110, 0.146),
        (0.0130, 0.147),
        (0.0125, 0.172),
    ),
    colour=(150, 164, 36),
    paint=_olive_oil,
    mass=0.20,
    shoulder=0.106,
    neck=0.0125,
)


_ALL = (KETCHUP, BBQ, DETERGENT, SOFTENER, COFFEE, PROTEIN, OLIVE_OIL)
BUILDERS: dict[str, Callable[[Builder], Asset]] = {bottle.key: bottle.build for bottle in _ALL}
