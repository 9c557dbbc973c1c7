"""Generate light triangle meshes: surfaces of revolution, boxes, tubes and their deformations.

Texture coordinates: u increases to the right and v downwards in the image (its first row is v = 0).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Half = tuple[float, float, float]
"""Half sizes along x, y and z [m]."""

# Order of the faces of a box in an atlas of 3 x 2 cells (see `paint.atlas`).
BOX_FACES = ("+x", "+y", "+z", "-x", "-y", "-z")


@dataclass(frozen=True)
class MeshData:
    """Triangles: vertices (N, 3) [m], faces (M, 3) counter-clockwise from outside, uv (K, 2) and its indices.

    ``uv_faces`` (M, 3) indexes ``uv``; without it ``uv`` goes by vertex.
    """

    vertices: Floats
    faces: Ints
    uv: Floats | None = None
    uv_faces: Ints | None = None

    def moved(self, offset: Sequence[float]) -> MeshData:
        """Return the mesh shifted by ``offset`` (3,) [m]."""
        return self.warped(lambda points: points + np.asarray(offset, dtype=np.float64))

    def warped(self, function: Callable[[Floats], Floats]) -> MeshData:
        """Return the mesh with its vertices (N, 3) passed through ``function``."""
        return MeshData(function(self.vertices.copy()), self.faces, self.uv, self.uv_faces)

    def turned(self, axis: Sequence[float], angle: float) -> MeshData:
        """Return the mesh turned by ``angle`` [rad] about ``axis`` through the origin."""
        unit = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
        cross = np.array([[0, -unit[2], unit[1]], [unit[2], 0, -unit[0]], [-unit[1], unit[0], 0]])
        matrix = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
        return self.warped(lambda points: points @ matrix.T)

    def with_uv(self, u: float, v: float) -> MeshData:
        """Return the mesh with one texture coordinate everywhere (a palette entry)."""
        return MeshData(self.vertices, self.faces, np.array([[u, v]]), np.zeros_like(self.faces))

    def without_uv(self) -> MeshData:
        """Return the mesh without texture coordinates."""
        return MeshData(self.vertices, self.faces)


def merged(*meshes: MeshData) -> MeshData:
    """Return one mesh of all; either all of them have texture coordinates or none."""
    vertices, faces, uv, uv_faces = [], [], [], []
    count = uv_count = 0
    for mesh in meshes:
        vertices.append(mesh.vertices)
        faces.append(mesh.faces + count)
        count += len(mesh.vertices)
        if mesh.uv is not None:
            uv.append(mesh.uv)
            uv_faces.append((mesh.faces if mesh.uv_faces is None else mesh.uv_faces) + uv_count)
            uv_count += len(mesh.uv)
    if not uv:
        return MeshData(np.concatenate(vertices), np.concatenate(faces))
    return MeshData(np.concatenate(vertices), np.concatenate(faces), np.concatenate(uv), np.concatenate(uv_faces))


def lathe(
    profile: Sequence[tuple[float, float]],
    segments: int = 24,
    by_length: bool = False,
    scale: tuple[float, float] = (1.0, 1.0),
) -> MeshData:
    """Return the surface of revolution of a profile of (radius, z), given from the bottom up the outside.

    u runs around, with u = 0.5 at +x and growing towards +y: a label in the middle of the image faces +x.
    v goes by height from the top (0) to the bottom (1), or by length along the profile from its end to its
    start when ``by_length``. ``scale`` squeezes x and y into an ellipse. A profile may go on over a rim and
    down the inside.
    """
    radii, heights = (np.array(values, dtype=np.float64) for values in zip(*profile, strict=True))
    if by_length:
        way = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(radii), np.diff(heights)))])
        v = 1 - way / way[-1]
    else:
        v = (heights.max() - heights) / np.ptp(heights)
    vertices, rings = _rings(radii, heights, segments, scale)
    faces, uv_faces = _between_rings(rings)
    # Textures repeat: avoid the first and last row, which blend into each other.
    v = 0.008 + 0.984 * v
    u = np.linspace(0.0, 1.0, segments + 1)
    uv = np.stack([np.tile(u, len(v)), np.repeat(v, segments + 1)], axis=1)
    return MeshData(np.array(vertices), np.array(faces), uv, np.array(uv_faces))


def _rings(
    radii: Floats, heights: Floats, segments: int, scale: tuple[float, float]
) -> tuple[list[tuple[float, float, float]], list[list[int]]]:
    """Return the vertices of a lathe's rings, one for a ring without radius, and the indices around each, closed."""
    angles = np.linspace(-np.pi, np.pi, segments + 1)[:segments]
    vertices: list[tuple[float, float, float]] = []
    rings: list[list[int]] = []
    for radius, z in zip(radii, heights, strict=True):
        first = len(vertices)
        if radius <= 0:
            rings.append([first] * (segments + 1))
            vertices.append((0.0, 0.0, z))
        else:
            rings.append([*range(first, first + segments), first])
            vertices += [(radius * np.cos(a) * scale[0], radius * np.sin(a) * scale[1], z) for a in angles]
    return vertices, rings


def _between_rings(rings: list[list[int]]) -> tuple[list[list[int]], list[list[int]]]:
    """Return the triangles between neighbouring rings, as indices of vertices and of texture coordinates."""
    faces, uv_faces = [], []
    width = len(rings[0])
    for i in range(len(rings) - 1):
        for j in range(width - 1):
            quad = (rings[i][j], rings[i][j + 1], rings[i + 1][j + 1], rings[i + 1][j])
            base = i * width + j
            uv_quad = (base, base + 1, base + width + 1, base + width)
            for corners in ((0, 1, 2), (0, 2, 3)):
                triangle = [quad[c] for c in corners]
                if len(set(triangle)) == 3:
                    faces.append(triangle)
                    uv_faces.append([uv_quad[c] for c in corners])
    return faces, uv_faces


def ball(radii: Sequence[float], segments: int = 16, rings: int = 9) -> MeshData:
    """Return an ellipsoid with half axes ``radii`` (3,) [m]."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, rings + 1)
    profile = [(max(0.0, float(np.cos(a))) if 0 < k < rings else 0.0, float(np.sin(a))) for k, a in enumerate(angles)]
    return lathe(profile, segments).warped(lambda points: points * np.asarray(radii, dtype=np.float64))


def box(half: Sequence[float]) -> MeshData:
    """Return a box with the cells of a 3 x 2 atlas on its faces, upright when viewed from outside.

    On the top and bottom faces the image's right is +y, as in the agentview camera.
    """
    x, y, z = half
    sides = {
        "+x": ((x, 0, 0), (0, y, 0), (0, 0, z)),
        "-x": ((-x, 0, 0), (0, -y, 0), (0, 0, z)),
        "+y": ((0, y, 0), (-x, 0, 0), (0, 0, z)),
        "-y": ((0, -y, 0), (x, 0, 0), (0, 0, z)),
        "+z": ((0, 0, z), (0, y, 0), (-x, 0, 0)),
        "-z": ((0, 0, -z), (0, y, 0), (x, 0, 0)),
    }
    quads, cells = [], []
    for k, face in enumerate(BOX_FACES):
        centre, right, up = (np.array(vector, dtype=np.float64) for vector in sides[face])
        quads.append([centre - right - up, centre + right - up, centre + right + up, centre - right + up])
        cells.append((k % 3, k // 3))
    return quads_mesh(quads, [cell_uv(column, row) for column, row in cells])


def cell_uv(column: int, row: int, columns: int = 3, rows: int = 2) -> Floats:
    """Return the corners (4, 2) of an atlas cell, counter-clockwise from bottom left, a hair inside."""
    inset = 0.01
    left, right = (column + inset) / columns, (column + 1 - inset) / columns
    top, bottom = (row + inset) / rows, (row + 1 - inset) / rows
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


Quad = Sequence[Sequence[float] | Floats]
"""Four corners (3,), counter-clockwise from outside."""


def quads_mesh(quads: Sequence[Quad], uvs: Sequence[Floats]) -> MeshData:
    """Return a mesh of flat quads with their uv (4, 2)."""
    vertices = np.array([corner for quad in quads for corner in quad], dtype=np.float64)
    faces = [[4 * k + a, 4 * k + b, 4 * k + c] for k in range(len(quads)) for a, b, c in ((0, 1, 2), (0, 2, 3))]
    return MeshData(vertices, np.array(faces), np.concatenate(uvs))


def grid_faces(columns: int, rows: int, first: int = 0) -> list[tuple[int, int, int]]:
    """Return the triangles of a grid with (rows + 1) × (columns + 1) vertices, row by row from index ``first``."""
    faces = []
    for i in range(rows):
        for j in range(columns):
            p = first + i * (columns + 1) + j
            q = p + columns + 1
            faces += [(p, p + 1, q + 1), (p, q + 1, q)]
    return faces


@dataclass(frozen=True)
class Block:
    """A box in a set of boards: centre and half sizes [m], and the axis of the grain."""

    centre: tuple[float, float, float]
    half: tuple[float, float, float]
    grain: int = 0


def blocks(parts: Sequence[Block], tile: float = 0.3) -> MeshData:
    """Return many boxes as one mesh; the image repeats every ``tile`` metres, its u along the grain."""
    quads, uvs = [], []
    for number, part in enumerate(parts):
        # Shift the texture per board.
        shift = np.array([0.37 * number, 0.61 * number])
        for axis in range(3):
            along = part.grain if part.grain != axis else (axis + 1) % 3
            across = 3 - axis - along
            for sign in (-1.0, 1.0):
                corners = _block_side(np.array(part.half), axis, sign)
                uvs.append(np.array([[c[along], c[across]] for c in corners]) / tile + shift)
                quads.append([corner + np.array(part.centre) for corner in corners])
    return quads_mesh(quads, uvs)


def _block_side(half: Floats, axis: int, sign: float) -> list[Floats]:
    """Return the corners of the side of a box that faces along or against an axis."""
    corners: list[Floats] = []
    for p, q in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        corner = np.zeros(3)
        corner[axis] = sign * half[axis]
        corner[(axis + 1) % 3], corner[(axis + 2) % 3] = p * half[(axis + 1) % 3], q * half[(axis + 2) % 3]
        corners.append(corner)
    return corners[::-1] if sign < 0 else corners


def tube(
    path: Sequence[Sequence[float]],
    radii: Sequence[float | tuple[float, float]],
    sides: int = 8,
    up: Sequence[float] = (0.0, 0.0, 1.0),
) -> MeshData:
    """Return a closed tube along ``path`` (K, 3); a radius may be (sideways, upwards) for a flat section."""
    points = np.array(path, dtype=np.float64)
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    vertices: list[Floats] = []
    for point, tangent, radius in zip(points, tangents, radii, strict=True):
        side = np.cross(tangent, np.asarray(up, dtype=np.float64))
        side /= np.linalg.norm(side)
        over = np.cross(side, tangent)
        a, b = radius if isinstance(radius, tuple) else (radius, radius)
        vertices += [point + a * np.cos(t) * side + b * np.sin(t) * over for t in angles]
    vertices += [points[0], points[-1]]
    return MeshData(np.array(vertices), np.array(_tube_faces(len(points), sides)))


def _tube_faces(rings: int, sides: int) -> list[list[int]]:
    """Return the triangles of a tube's wall and ends; the end centres follow the rings."""
    faces = []
    for i in range(rings - 1):
        for j in range(sides):
            k = (j + 1) % sides
            p, q, r, s = i * sides + j, i * sides + k, (i + 1) * sides + k, (i + 1) * sides + j
            faces += [[p, r, q], [p, s, r]]
    start, end = rings * sides, rings * sides + 1
    for j in range(sides):
        k = (j + 1) % sides
        faces += [[start, j, k], [end, (rings - 1) * sides + k, (rings - 1) * sides + j]]
    return faces
