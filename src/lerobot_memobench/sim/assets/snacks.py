"""Small food beside the vegetables: a bag of snacks, a chestnut, a biscuit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Floats, Half, MeshData, grid_faces, lathe
from lerobot_memobench.sim.assets.paint import WHITE, Canvas, Colour, Pixels, drawn

# Bag of snacks ---------------------------------------------------------------------------------
_BAG = (0.0230, 0.0480, 0.0600)


def _bag_mesh(half: Half) -> MeshData:
    """Return a bag on a gusset, pressed flat at the top; the image's halves are front and back."""
    columns, rows = 8, 9
    vertices: list[tuple[float, float, float]] = []
    uv: list[tuple[float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for sign in (1.0, -1.0):
        faces += grid_faces(columns, rows, len(vertices))
        for i in range(rows + 1):
            for j in range(columns + 1):
                vertices.append(_bag_point(half, sign, 2 * j / columns - 1, i / rows))
                uv.append((0.01 + 0.48 * j / columns + (0.0 if sign > 0 else 0.5), 0.99 - 0.98 * (i / rows)))
    back = (rows + 1) * (columns + 1)
    for j in range(columns):
        # The gusset: front and back edges run in opposite directions.
        faces.append((j, back + columns - j, j + 1))
        faces.append((j + 1, back + columns - j, back + columns - j - 1))
    return MeshData(np.array(vertices), np.array(faces), np.array(uv))


def _bag_point(half: Half, sign: float, across: float, up: float) -> tuple[float, float, float]:
    """Return a point of the bag's front (or back, ``sign`` -1): ``across`` from -1 to 1, ``up`` from 0 to 1."""
    x, y, z = half
    # Thick below, flat at the seam on top; the bag narrows a little where it is full.
    thick = np.sqrt(max(0.0, 1 - (max(0.0, up - 0.25) / 0.66) ** 2)) if up < 0.9 else 0.0
    thick = max(0.06, thick * (0.72 + 0.28 * min(1.0, up / 0.2)))
    wide = y * (1 - 0.05 * np.sin(np.pi * min(1.0, up / 0.9)))
    bulge = thick * (1 - abs(across) ** 2.6) ** 0.6
    return sign * x * bulge, sign * wide * across, -z + 2 * z * up


def _bag_texture() -> Pixels:
    green: Colour = (24, 132, 74)
    yellow: Colour = (252, 206, 52)

    def side(canvas: Canvas) -> None:
        canvas.rect(0, 0, 1, 0.085, (206, 210, 214))
        for k in range(24):
            canvas.rect(k / 24, 0, k / 24 + 0.016, 0.085, (150, 156, 162))
        canvas.oval(-0.1, 0.22, 1.1, 0.58, (206, 34, 36))
        canvas.text("CHIPS", 0.10, 0.28, 0.90, 0.52, WHITE)
        for x, y in ((0.14, 0.66), (0.42, 0.62), (0.62, 0.70), (0.30, 0.77), (0.52, 0.82)):
            canvas.oval(x, y, x + 0.27, y + 0.13, (196, 138, 30))
            canvas.oval(x + 0.01, y, x + 0.26, y + 0.11, yellow)
            canvas.oval(x + 0.07, y + 0.03, x + 0.19, y + 0.07, (240, 184, 40))

    half = drawn(128, 200, green, side)
    return np.concatenate([half, half], axis=1)


def _bag_of_snacks(b: Builder) -> Asset:
    half = _BAG
    b.visual_mesh(
        b.mesh("bag_of_snacks", lambda: _bag_mesh(half)),
        b.material("bag_of_snacks", _bag_texture, specular=0.7, shininess=0.6),
    )
    x, y, z = half
    b.collision("box", (0.72 * x, 0.94 * y, z - 0.008), 0.05, (0, 0, -0.008), friction=GRIP_FRICTION)
    b.collision("box", (x, 0.6 * y, 0.5 * z), 0.03, (0, 0, -0.25 * z), friction=GRIP_FRICTION)
    b.collision("box", (0.10 * x, 0.94 * y, 0.008), 0.002, (0, 0, z - 0.008), friction=GRIP_FRICTION)
    b.grasp((0, 0, z - 0.030), ALONG_X, 1.44 * x, depth=0.02)
    return b.object((-x, -y, -z), half)


# Chestnut --------------------------------------------------------------------------------------
_CHESTNUT = (0.0195, 0.0235, 0.0180)


def _chestnut_mesh() -> MeshData:
    x, y, half = _CHESTNUT
    profile = [(0.0, -half), (0.62, -half), (0.90, -0.72 * half), (1.0, -0.25 * half), (0.93, 0.20 * half)]
    profile += [(0.70, 0.60 * half), (0.38, 0.80 * half), (0.13, 0.90 * half), (0.06, half), (0.0, half)]
    return lathe(profile, 16, scale=(x, y))


def _chestnut_texture() -> Pixels:
    def paint(canvas: Canvas) -> None:
        for k in range(40):
            canvas.line((112, 50, 24), 0.006, k / 40, 0.08, k / 40 + 0.012, 0.68)
        canvas.rect(0, 0, 1, 0.09, (226, 204, 160))
        points: list[float] = []
        for k in range(49):
            points += [k / 48, 0.70 + 0.03 * float(np.sin(2 * np.pi * 3 * k / 48))]
        canvas.shape((206, 172, 124), *points, 1, 1, 0, 1)

    return drawn(192, 96, (92, 38, 18), paint)


def _chestnut(b: Builder) -> Asset:
    x, y, half = _CHESTNUT
    b.visual_mesh(
        b.mesh("chestnut", _chestnut_mesh, smooth=True),
        b.material("chestnut", _chestnut_texture, specular=0.9, shininess=0.8),
    )
    b.collision("box", (x, 0.70 * y, 0.45 * half), 0.02, (0, 0, -0.15 * half), friction=GRIP_FRICTION)
    b.collision("box", (0.70 * x, y, 0.45 * half), 0.01, (0, 0, -0.15 * half), friction=GRIP_FRICTION)
    b.collision("cylinder", (0.60 * x, 0.90 * half), 0.01, (0, 0, -0.10 * half))
    b.grasp((0, 0, -0.002), ALONG_X, 2 * x, depth=0.008)
    b.grasp((0, 0, -0.002), ALONG_Y, 2 * y, depth=0.008)
    return b.object((-x, -y, -half), (x, y, half))


# Biscuit ---------------------------------------------------------------------------------------
_BISCUIT = (0.0290, 0.0115)


def _biscuit_mesh() -> MeshData:
    """Return two scalloped biscuits with cream between them."""
    radius, half = _BISCUIT
    profile = [
        (0.0, -half),
        (radius - 0.002, -half),
        (radius, -half + 0.002),
        (radius, -0.0030),
        (radius - 0.003, -0.0025),
    ]
    profile += [(radius - 0.003, 0.0025), (radius, 0.0030), (radius, half - 0.002), (radius - 0.002, half)]
    profile += [(0.55 * radius, half - 0.0008), (0.0, half - 0.0005)]

    def scallop(points: Floats) -> Floats:
        angle = np.arctan2(points[:, 1], points[:, 0])
        points[:, :2] *= (0.975 + 0.025 * np.cos(np.round(angle * 16 / np.pi) * np.pi))[:, None]
        return points

    return lathe(profile, 32, by_length=True).warped(scallop)


def _biscuit_texture() -> Pixels:
    brown, gold = (150, 90, 36), (222, 166, 86)

    def paint(canvas: Canvas) -> None:
        # Rows: middle of the top, its holes and edge, the side with cream, the underside.
        canvas.rect(0, 0.30, 1, 0.40, (206, 146, 70))
        for k in range(10):
            canvas.oval(k / 10 + 0.035, 0.245, k / 10 + 0.065, 0.285, brown)
        for k in range(5):
            canvas.oval(k / 5 + 0.06, 0.120, k / 5 + 0.14, 0.160, brown)
        canvas.rect(0, 0.475, 1, 0.60, (250, 236, 206))

    return drawn(256, 256, gold, paint)


def _biscuit(b: Builder) -> Asset:
    radius, half = _BISCUIT
    b.visual_mesh(
        b.mesh("biscuit", _biscuit_mesh), b.material("biscuit", _biscuit_texture, specular=0.1, shininess=0.2)
    )
    b.collision("cylinder", (radius, half), 0.04, friction=GRIP_FRICTION)
    b.grasp((0, 0, 0), ALONG_X, 2 * radius, symmetric=True, depth=0.006)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {
    "bag_of_snacks": _bag_of_snacks,
    "chestnut": _chestnut,
    "biscuit": _biscuit,
}
