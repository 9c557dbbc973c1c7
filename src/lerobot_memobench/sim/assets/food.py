"""Build vegetables and snacks: tomato, artichoke, broccoli, Brussels sprout, bag of snacks, chestnut, biscuit.

Vegetables fit into the gripper and the drawers; collision geoms have flat bottoms to prevent rolling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lerobot_memobench.sim.assets.asset import ALONG_X, ALONG_Y, Asset
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Floats, MeshData, ball, grid_faces, lathe, merged, tube
from lerobot_memobench.sim.assets.paint import WHITE, Canvas, Colour, Pixels, draw_texture


def _round_contacts(b: Builder, radius: float, half: float, mass: float, foot: float = 0.62) -> None:
    """Add two collision cylinders: a wide one around the centre for the fingers, a narrow tall one as the base."""
    b.collision("cylinder", (radius, 0.42 * half), 0.6 * mass, friction=GRIP_FRICTION)
    b.collision("cylinder", (foot * radius, half), 0.4 * mass, friction=GRIP_FRICTION)


# Tomato ----------------------------------------------------------------------------------------
_TOMATO = (0.031, 0.0245)


def _tomato_mesh() -> MeshData:
    radius, half = _TOMATO
    angles = np.radians([-90, -72, -50, -28, -8, 12, 32, 52, 68, 80])
    profile = [(radius * float(np.cos(a)) ** 0.85 if a > -1.5 else 0.0, half * float(np.sin(a))) for a in angles]
    profile.append((0.0, 0.86 * half))
    body = lathe(profile, 24)

    def lobes(points: Floats) -> Floats:
        angle = np.arctan2(points[:, 1], points[:, 0])
        share = 1 + 0.045 * np.cos(6 * angle + 0.6) * np.clip((points[:, 2] / half + 0.8), 0, 1.2) / 1.2
        points[:, :2] *= (share / 1.045)[:, None]
        return points

    return body.warped(lobes).without_uv()


def _calyx_mesh() -> MeshData:
    """Return six leaves on the tomato's shoulder, and a stem stub."""
    leaves = []
    for k in range(6):
        long = 0.019 if k % 2 else 0.016
        vertices = [(0, 0, 0.0225), (0.008, -0.0045, 0.0250), (0.008, 0.0045, 0.0250), (long, 0, 0.0228)]
        leaf = MeshData(np.array(vertices, dtype=np.float64), np.array([(0, 1, 2), (1, 3, 2)]))
        leaves.append(leaf.turned((0, 0, 1), 2 * np.pi * k / 6 + 0.2))
    stem = tube([(0, 0, 0.021), (0.001, 0, 0.0275)], [0.0030, 0.0020], sides=5, up=(1, 0, 0))
    return merged(*leaves, stem)


def _tomato(b: Builder) -> Asset:
    red = b.material("tomato", rgba=(0.80, 0.10, 0.06, 1), specular=0.6, shininess=0.7)
    green = b.material("tomato_green", rgba=(0.20, 0.48, 0.13, 1), specular=0.1)
    b.visual_mesh(b.mesh("tomato", _tomato_mesh, smooth=True), red)
    b.visual_mesh(b.mesh("tomato_calyx", _calyx_mesh), green)
    radius, half = _TOMATO
    _round_contacts(b, radius, half, 0.10)
    b.grasp((0, 0, 0), ALONG_X, 2 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half + 0.002), round=True)


# Artichoke -------------------------------------------------------------------------------------
_ARTICHOKE = (0.0285, 0.0260)


def _scale(
    angle: float, elevation: float, radii: tuple[float, float], wide: float, long: float, lift: float
) -> MeshData:
    """Return a two-sided leaf on an ellipsoid of ``radii`` (sideways, up), with its tip upwards."""
    side, up = radii

    def spot(e: float, a: float, out: float) -> Floats:
        point = np.array([np.cos(e) * np.cos(a) * side, np.cos(e) * np.sin(a) * side, np.sin(e) * up])
        return point * (1 + out)

    top = min(elevation + long, 1.50)
    vertices = [
        spot(elevation - 0.6 * long, angle - 0.7 * wide, 0.0),
        spot(elevation - 0.6 * long, angle + 0.7 * wide, 0.0),
        spot(elevation + 0.2 * long, angle + wide, 0.4 * lift),
        spot(top, angle, lift),
        spot(elevation + 0.2 * long, angle - wide, 0.4 * lift),
        spot(elevation, angle, 0.8 * lift),
    ]
    faces = [(0, 1, 5), (1, 2, 5), (2, 3, 5), (3, 4, 5), (4, 0, 5)]
    # Palette: base of the leaf pale, tip dark.
    uv = np.array([(0.5, 0.95), (0.5, 0.95), (0.5, 0.45), (0.5, 0.04), (0.5, 0.45), (0.5, 0.75)])
    leaf = MeshData(np.array(vertices), np.array(faces), uv)
    return merged(leaf, replace(leaf, faces=leaf.faces[:, ::-1]))


def _artichoke_mesh() -> MeshData:
    radius, half = _ARTICHOKE
    radii = (0.92 * radius, 0.89 * half)
    parts = [ball((0.91 * radius, 0.91 * radius, 0.88 * half), 12, 7).with_uv(0.5, 0.70)]
    for row, (elevation, count) in enumerate(((-0.75, 7), (-0.32, 8), (0.10, 8), (0.50, 7), (0.88, 5), (1.18, 4))):
        wide = 0.72 * np.pi / count + 0.08
        for k in range(count):
            angle = 2 * np.pi * (k + 0.5 * (row % 2)) / count
            parts.append(_scale(angle, elevation, radii, wide, 0.48, 0.13))
    parts.append(lathe([(0.0, -half), (0.009, -half), (0.011, -0.7 * half)], 8).with_uv(0.5, 0.95))
    return merged(*parts)


def _artichoke_texture() -> Pixels:
    high = np.linspace(0, 1, 64)[:, None]
    tip, middle, base = np.array((104, 58, 92)), np.array((74, 112, 52)), np.array((150, 182, 96))
    low = np.clip(high * 3.2, 0, 1)
    colour = tip * (1 - low) + middle * low
    rest = np.clip((high - 0.5) * 2.0, 0, 1)
    colour = colour * (1 - rest) + base * rest
    return np.repeat(colour[:, None, :], 16, axis=1).astype(np.uint8)


def _artichoke(b: Builder) -> Asset:
    radius, half = _ARTICHOKE
    b.textured_mesh("artichoke", _artichoke_mesh, _artichoke_texture, specular=0.15, shininess=0.3)
    _round_contacts(b, 0.94 * radius, half, 0.10)
    b.grasp((0, 0, 0), ALONG_X, 1.88 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


# Broccoli --------------------------------------------------------------------------------------
_BROCCOLI = (0.0320, 0.0260)


def _broccoli_crown() -> MeshData:
    """Return knobbly heads around a higher one."""
    rng = np.random.default_rng(8)
    _, half = _BROCCOLI
    spots = [(0.0, 0.0, half - 0.0150, 0.0150)]
    spots += [
        (0.0185 * np.cos(a), 0.0185 * np.sin(a), half - 0.0225 + 0.0015 * (k % 2), 0.0130)
        for k, a in enumerate(np.linspace(0, 2 * np.pi, 7)[:-1])
    ]
    heads = []
    for x, y, z, size in spots:
        head = ball((size, size, 0.92 * size), 8, 6)
        knobs = 1 + rng.uniform(-0.10, 0.09, size=(len(head.vertices), 1))
        heads.append(replace(head, vertices=head.vertices * knobs).moved((x, y, z)))
    return merged(*heads)


def _broccoli_stalk() -> MeshData:
    _, half = _BROCCOLI
    profile = [(0.0, -half), (0.0125, -half), (0.0115, -0.55 * half), (0.0150, -0.05 * half), (0.02, 0.1 * half)]
    return lathe(profile, 9).without_uv()


def _broccoli_texture() -> Pixels:
    """Return dark green buds with light tips."""
    rng = np.random.default_rng(9)
    noise = rng.random((64, 64, 1))
    colour = np.where(noise > 0.72, np.array((96, 150, 62)), np.where(noise > 0.3, (44, 104, 40), (26, 74, 30)))
    return colour.astype(np.uint8)


def _broccoli(b: Builder) -> Asset:
    radius, half = _BROCCOLI
    crown = b.material("broccoli", _broccoli_texture, specular=0.05, shininess=0.1)
    stalk = b.material("broccoli_stalk", rgba=(0.66, 0.78, 0.44, 1), specular=0.1)
    b.visual_mesh(b.mesh("broccoli", _broccoli_crown), crown)
    b.visual_mesh(b.mesh("broccoli_stalk", _broccoli_stalk), stalk)
    b.collision("cylinder", (0.0140, 0.5 * half), 0.06, (0, 0, -0.5 * half))
    b.collision("cylinder", (0.94 * radius, 0.010), 0.03, (0, 0, 0.1 * half), friction=GRIP_FRICTION)
    b.collision("cylinder", (0.6 * radius, 0.4 * half), 0.01, (0, 0, 0.6 * half))
    b.grasp((0, 0, 0.1 * half), ALONG_X, 1.88 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


# Brussels sprout -------------------------------------------------------------------------------
_SPROUT = (0.0250, 0.0235)


def _sprout_leaf(angle: float, tilt: float, wide: float, out: float) -> MeshData:
    """Return a leaf that wraps the ball from below with a raised edge."""
    radius, half = _SPROUT
    columns, rows = 5, 4
    vertices, uv = [], []
    for i in range(rows + 1):
        elevation = -1.15 + (tilt + 1.15) * i / rows
        share = np.sqrt(max(0.02, 1 - (i / rows) ** 2.2)) if i == rows else 1.0
        for j in range(columns + 1):
            across = 2 * j / columns - 1
            a = angle + wide * across * share * (0.75 + 0.25 * i / rows)
            off = 0.93 + out * (0.3 + 0.7 * (i / rows) ** 2) * (0.5 + 0.5 * across**2)
            e = elevation - 0.25 * across**2 * (i / rows)
            vertices.append(
                (
                    off * radius * np.cos(e) * np.cos(a),
                    off * radius * np.cos(e) * np.sin(a),
                    off * half * np.sin(e),
                )
            )
            uv.append((0.5 + 0.48 * across, 0.98 - 0.96 * i / rows))
    return MeshData(np.array(vertices), np.array(grid_faces(columns, rows)), np.array(uv))


def _sprout_mesh() -> MeshData:
    radius, half = _SPROUT
    core = ball((0.92 * radius, 0.92 * radius, 0.95 * half), 14, 8)
    leaves = [
        _sprout_leaf(2 * np.pi * k / 5 + 0.35, 0.55 + 0.35 * (k % 2), 0.85, 0.07 + 0.02 * (k % 2)) for k in range(5)
    ]
    stem = lathe([(0.0, -half), (0.009, -half), (0.010, -0.8 * half)], 8).with_uv(0.5, 0.99)
    return merged(core, *leaves, stem)


def _sprout_texture() -> Pixels:
    """Return a leaf: pale ribs on green, paler towards the foot."""
    light = (206, 222, 150)

    def ribs(canvas: Canvas) -> None:
        canvas.rect(0, 0.86, 1, 1, (196, 212, 140))
        canvas.line(light, 0.035, 0.5, 1.0, 0.5, 0.04)
        for y in (0.25, 0.48, 0.70):
            for s in (-1.0, 1.0):
                canvas.line(light, 0.018, 0.5, y + 0.10, 0.5 + 0.22 * s, y, 0.5 + 0.42 * s, y - 0.16)
        canvas.rect(0, 0, 1, 0.05, (158, 190, 92))
        canvas.rect(0, 0, 0.04, 1, (150, 184, 88))
        canvas.rect(0.96, 0, 1, 1, (150, 184, 88))

    return draw_texture(96, 96, (108, 156, 58), ribs)


def _sprout(b: Builder) -> Asset:
    radius, half = _SPROUT
    b.textured_mesh("brussels_sprout", _sprout_mesh, _sprout_texture, specular=0.25, shininess=0.4)
    _round_contacts(b, radius, half, 0.05, foot=0.55)
    b.grasp((0, 0, 0), ALONG_X, 2 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


# Bag of snacks ---------------------------------------------------------------------------------
_BAG = (0.0230, 0.0480, 0.0600)


def _bag_mesh() -> MeshData:
    """Return a bag on a gusset, pressed flat at the top; the image's halves are front and back."""
    columns, rows = 8, 9
    vertices: list[tuple[float, float, float]] = []
    uv: list[tuple[float, float]] = []
    faces: list[tuple[int, int, int]] = []
    for sign in (1.0, -1.0):
        faces += grid_faces(columns, rows, len(vertices))
        for i in range(rows + 1):
            for j in range(columns + 1):
                vertices.append(_bag_point(sign, 2 * j / columns - 1, i / rows))
                uv.append((0.01 + 0.48 * j / columns + (0.0 if sign > 0 else 0.5), 0.99 - 0.98 * (i / rows)))
    back = (rows + 1) * (columns + 1)
    for j in range(columns):
        # The gusset: front and back edges run in opposite directions.
        faces.append((j, back + columns - j, j + 1))
        faces.append((j + 1, back + columns - j, back + columns - j - 1))
    return MeshData(np.array(vertices), np.array(faces), np.array(uv))


def _bag_point(sign: float, across: float, up: float) -> tuple[float, float, float]:
    """Return a point of the bag's front (or back, ``sign`` -1): ``across`` from -1 to 1, ``up`` from 0 to 1."""
    x, y, z = _BAG
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

    half = draw_texture(128, 200, green, side)
    return np.concatenate([half, half], axis=1)


def _bag_of_snacks(b: Builder) -> Asset:
    b.textured_mesh("bag_of_snacks", _bag_mesh, _bag_texture, specular=0.7, shininess=0.6)
    x, y, z = _BAG
    b.collision("box", (0.72 * x, 0.94 * y, z - 0.008), 0.05, (0, 0, -0.008), friction=GRIP_FRICTION)
    b.collision("box", (x, 0.6 * y, 0.5 * z), 0.03, (0, 0, -0.25 * z), friction=GRIP_FRICTION)
    b.collision("box", (0.10 * x, 0.94 * y, 0.008), 0.002, (0, 0, z - 0.008), friction=GRIP_FRICTION)
    b.grasp((0, 0, z - 0.030), ALONG_X, 1.44 * x)
    return b.object((-x, -y, -z), _BAG)


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

    return draw_texture(192, 96, (92, 38, 18), paint)


def _chestnut(b: Builder) -> Asset:
    x, y, half = _CHESTNUT
    b.textured_mesh("chestnut", _chestnut_mesh, _chestnut_texture, specular=0.9, shininess=0.8, smooth=True)
    b.collision("box", (x, 0.70 * y, 0.45 * half), 0.02, (0, 0, -0.15 * half), friction=GRIP_FRICTION)
    b.collision("box", (0.70 * x, y, 0.45 * half), 0.01, (0, 0, -0.15 * half), friction=GRIP_FRICTION)
    b.collision("cylinder", (0.60 * x, 0.90 * half), 0.01, (0, 0, -0.10 * half))
    b.grasp((0, 0, -0.002), ALONG_X, 2 * x)
    b.grasp((0, 0, -0.002), ALONG_Y, 2 * y)
    return b.object((-x, -y, -half), (x, y, half))


# Biscuit ---------------------------------------------------------------------------------------
_BISCUIT = (0.0290, 0.0115)


def _biscuit_mesh() -> MeshData:
    """Return two scalloped biscuits with cream between them."""
    radius, half = _BISCUIT
    profile = [(0.0, -half), (radius - 0.002, -half), (radius, -half + 0.002)]
    profile += [
        (radius, -0.0030),
        (radius - 0.003, -0.0025),
        (radius - 0.003, 0.0025),
        (radius, 0.0030),
        (radius, half - 0.002),
        (radius - 0.002, half),
    ]
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

    return draw_texture(256, 256, gold, paint)


def _biscuit(b: Builder) -> Asset:
    radius, half = _BISCUIT
    b.textured_mesh("biscuit", _biscuit_mesh, _biscuit_texture, specular=0.1, shininess=0.2)
    b.collision("cylinder", (radius, half), 0.04, friction=GRIP_FRICTION)
    b.grasp((0, 0, 0), ALONG_X, 2 * radius, symmetric=True)
    return b.object((-radius, -radius, -half), (radius, radius, half), round=True)


BUILDERS: dict[str, Callable[[Builder], Asset]] = {
    "beefsteak_tomato": _tomato,
    "artichoke": _artichoke,
    "broccoli": _broccoli,
    "brussels_sprouts": _sprout,
    "bag_of_snacks": _bag_of_snacks,
    "chestnut": _chestnut,
    "biscuit": _biscuit,
}
