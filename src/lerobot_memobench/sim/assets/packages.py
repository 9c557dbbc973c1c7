"""Things in boxes, blocks and cartons, with labels that can be read: butter, cereal, flour, milk …"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Floats, Half, MeshData, Quad, box, cell_uv, quads_mesh
from lerobot_memobench.sim.assets.paint import BLACK, WHITE, Canvas, Colour, Pixels, atlas, draw_texture, wrapped


@dataclass(frozen=True)
class Package:
    """A textured box, grasped across every horizontal extent up to ``widest``, m."""

    key: str
    half: Half
    texture: Callable[[], Pixels]
    mass: float
    widest: float = 0.066

    def build(self, b: Builder) -> Asset:
        """Add the package to the scene."""
        b.textured_mesh(self.key, lambda: box(self.half), self.texture, specular=0.25, shininess=0.4)
        b.collision("box", self.half, self.mass, friction=GRIP_FRICTION)
        x, y, z = self.half
        # A finger reaches about 4 cm below the palm and must not touch the table.
        at = max(0.0, z - 0.032)
        for yaw, width in sorted(((ALONG_X, 2 * x), (ALONG_Y, 2 * y)), key=lambda pair: pair[1]):
            if width <= self.widest:
                b.grasp((0, 0, at), yaw, width)
        return b.object((-x, -y, -z), self.half)


# Butter ----------------------------------------------------------------------------------------
def _butter_texture() -> Pixels:
    yellow: Colour = (250, 204, 62)
    blue: Colour = (30, 70, 160)

    def top(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.10, blue)
        canvas.rect(0, 0.90, 1, 1, blue)
        canvas.oval(0.10, 0.16, 0.90, 0.84, (255, 240, 180))
        canvas.text("BUTTER", 0.24, 0.16, 0.76, 0.84, blue, turn=1)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 0.1, 1, blue)
        canvas.rect(0.9, 0, 1, 1, blue)
        canvas.text("BUTTER", 0.15, 0.15, 0.85, 0.85, blue)

    end = draw_texture(64, 32, yellow, lambda c: c.text("BUTTER", 0.08, 0.12, 0.92, 0.88, blue))
    long = draw_texture(128, 32, yellow, side)
    return atlas({"+z": draw_texture(96, 180, yellow, top), "+x": end, "-x": end, "+y": long, "-y": long}, yellow)


# Slightly shorter than the published one, so that it can be grasped by its ends next to close neighbours.
BUTTER = Package("butter", (0.0358, 0.0195, 0.0090), _butter_texture, 0.06, widest=0.073)


# Boxes -----------------------------------------------------------------------------------------
def _oatmeal_bowl(canvas: Canvas) -> None:
    canvas.oval(0.16, 0.54, 0.84, 0.74, (244, 226, 184))
    canvas.oval(0.24, 0.57, 0.76, 0.70, (226, 192, 128))
    canvas.shape((52, 98, 168), 0.16, 0.64, 0.84, 0.64, 0.68, 0.90, 0.32, 0.90)
    for x, y in ((0.40, 0.60), (0.55, 0.63), (0.62, 0.595)):
        canvas.oval(x, y, x + 0.07, y + 0.045, (60, 70, 150))


def _oatmeal_texture() -> Pixels:
    tan: Colour = (222, 186, 132)
    brown: Colour = (110, 62, 26)
    red: Colour = (188, 40, 36)

    def front(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.36, red)
        canvas.text("OATMEAL", 0.04, 0.06, 0.96, 0.32, WHITE)
        canvas.rect(0, 0.36, 1, 0.39, WHITE)
        _oatmeal_bowl(canvas)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.36, red)
        canvas.rect(0, 0.36, 1, 0.39, WHITE)
        canvas.text("OATMEAL", 0.30, 0.42, 0.70, 0.96, brown, turn=1)

    top = draw_texture(96, 64, red, lambda c: c.text("OATMEAL", 0.06, 0.1, 0.94, 0.9, WHITE))
    return wrapped(draw_texture(160, 224, tan, front), draw_texture(96, 224, tan, side), top, red)


OATMEAL = Package("box_of_oatmeal", (0.0240, 0.0480, 0.0690), _oatmeal_texture, 0.18)


def _cereal_loops(canvas: Canvas) -> None:
    canvas.oval(0.08, 0.60, 0.92, 0.96, (240, 246, 250))
    colours = ((220, 52, 48), (62, 160, 72), (240, 130, 30), (70, 110, 200))
    spots = ((0.18, 0.68), (0.38, 0.63), (0.58, 0.66), (0.72, 0.74), (0.28, 0.80), (0.48, 0.76), (0.56, 0.85))
    for k, (x, y) in enumerate(spots):
        canvas.oval(x, y, x + 0.13, y + 0.095, colours[k % 4])
        canvas.oval(x + 0.045, y + 0.032, x + 0.085, y + 0.063, (240, 246, 250))


def _cereal_texture() -> Pixels:
    yellow: Colour = (252, 196, 38)
    purple: Colour = (92, 42, 140)

    def front(canvas: Canvas) -> None:
        canvas.rect(0, 0.12, 1, 0.52, purple)
        canvas.text("CEREAL", 0.04, 0.16, 0.96, 0.48, WHITE)
        _cereal_loops(canvas)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0.12, 1, 0.52, purple)
        canvas.text("CEREAL", 0.25, 0.55, 0.75, 0.97, purple, turn=1)

    top = draw_texture(96, 64, yellow, lambda c: c.text("CEREAL", 0.06, 0.1, 0.94, 0.9, purple))
    return wrapped(draw_texture(160, 240, yellow, front), draw_texture(80, 240, yellow, side), top, yellow)


CEREAL = Package("box_of_cereal", (0.0210, 0.0500, 0.0720), _cereal_texture, 0.16)


def _ear_of_wheat(canvas: Canvas) -> None:
    gold: Colour = (204, 154, 52)
    canvas.line(gold, 0.035, 0.5, 0.97, 0.5, 0.60)
    for k in range(5):
        y = 0.60 + 0.06 * k
        canvas.shape(gold, 0.5, y + 0.07, 0.30, y + 0.02, 0.34, y - 0.03, 0.5, y + 0.03)
        canvas.shape(gold, 0.5, y + 0.07, 0.70, y + 0.02, 0.66, y - 0.03, 0.5, y + 0.03)
    canvas.oval(0.44, 0.53, 0.56, 0.62, gold)


def _flour_texture() -> Pixels:
    paper: Colour = (244, 236, 216)
    blue: Colour = (38, 78, 148)

    def front(canvas: Canvas) -> None:
        canvas.rect(0, 0.10, 1, 0.46, blue)
        canvas.text("FLOUR", 0.05, 0.14, 0.95, 0.42, WHITE)
        _ear_of_wheat(canvas)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0.10, 1, 0.46, blue)
        canvas.text("FLOUR", 0.28, 0.50, 0.72, 0.96, blue, turn=1)

    top = draw_texture(96, 64, paper, lambda c: c.text("FLOUR", 0.06, 0.1, 0.94, 0.9, blue))
    return wrapped(draw_texture(160, 224, paper, front), draw_texture(112, 224, paper, side), top, paper)


FLOUR = Package("box_of_flour", (0.0280, 0.0430, 0.0660), _flour_texture, 0.22)


# Bean curd -------------------------------------------------------------------------------------
def _bean_curd_texture() -> Pixels:
    cream: Colour = (246, 240, 218)
    green: Colour = (40, 130, 70)
    rim: Colour = (224, 230, 226)

    def top(canvas: Canvas) -> None:
        canvas.rect(0.05, 0.05, 0.95, 0.95, cream)
        canvas.rect(0.05, 0.30, 0.95, 0.72, green)
        canvas.text("TOFU", 0.12, 0.34, 0.88, 0.68, WHITE)
        for x in (0.28, 0.5, 0.72):
            canvas.oval(x - 0.07, 0.77, x + 0.07, 0.89, (214, 196, 130))

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.10, rim)
        canvas.rect(0.34, 0.10, 0.66, 1, green)
        for x in (0.17, 0.83):
            canvas.line((226, 218, 192), 0.012, x, 0.12, x, 1)

    edge = draw_texture(96, 64, cream, side)
    faces = {"+z": draw_texture(128, 128, rim, top), "+x": edge, "-x": edge, "+y": edge, "-y": edge}
    return atlas(faces, cream)


BEAN_CURD = Package("bean_curd", (0.0250, 0.0300, 0.0175), _bean_curd_texture, 0.12)


# Cartons of milk with a gable top ---------------------------------------------------------------


@dataclass(frozen=True)
class Carton:
    """A gable-top carton; its slopes begin ``shoulder`` below its top [m]."""

    key: str
    half: Half
    texture: Callable[[], Pixels]
    mass: float
    shoulder: float

    def build(self, b: Builder) -> Asset:
        """Add the carton to the scene."""
        b.textured_mesh(
            self.key, lambda: _carton_mesh(self.half, self.shoulder), self.texture, specular=0.25, shininess=0.4
        )
        x, y, z = self.half
        shoulder, base = self.shoulder, z - self.shoulder
        b.collision("box", (x, y, (base + z) / 2), 0.9 * self.mass, (0, 0, (base - z) / 2), friction=GRIP_FRICTION)
        gable = (0.35 * x, y, shoulder / 2)
        b.collision("box", gable, 0.1 * self.mass, (0, 0, z - shoulder / 2), friction=GRIP_FRICTION)
        at = z - 0.0325  # the palm nearly touches the fin
        b.grasp((0, 0, at), ALONG_X, 2 * x)
        b.grasp((0, 0, at), ALONG_Y, 2 * y)
        return b.object((-x, -y, -z), self.half)


def _carton_mesh(half: Half, shoulder: float) -> MeshData:
    """Return the carton's mesh with atlas cells as for a box; the slopes use the tops of front and back."""
    x, y, z = half
    base, ridge, thin = z - shoulder, z - 0.009, 0.0022
    # Half depth, height, and share of the front image below that height.
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

    return wrapped(
        draw_texture(128, 256, red, front), draw_texture(128, 256, red, side), draw_texture(16, 16, red), red
    )


MILK = Carton("milk", (0.0265, 0.0270, 0.0655), _milk_texture, 0.15, 0.032)


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

    return wrapped(
        draw_texture(128, 256, (226, 240, 250), front),
        draw_texture(128, 256, sky, side),
        draw_texture(16, 16, navy),
        navy,
    )


CARTON_OF_MILK = Carton("carton_of_milk", (0.0310, 0.0310, 0.0790), _carton_of_milk_texture, 0.20, 0.036)

_ALL: tuple[Package | Carton, ...] = (BUTTER, OATMEAL, CEREAL, FLOUR, BEAN_CURD, MILK, CARTON_OF_MILK)
BUILDERS: dict[str, Callable[[Builder], Asset]] = {thing.key: thing.build for thing in _ALL}
