"""The triangles of what MuJoCo knows as shapes: meshes, boxes, cylinders, spheres, ellipsoids, capsules."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError

ROUND = 32
"""Sides of cylinders and spheres."""

Triangles = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating], NDArray[np.integer]]
"""Positions (N, 3), normals (N, 3), texture coordinates (N, 2), triangles (M, 3)."""


def triangles_of(model: mujoco.MjModel, geom: int) -> Triangles:
    """Return a geom's triangles in its own frame.

    Raises:
        MemobenchError: for a shape that is not drawn here.
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    size = np.asarray(model.geom_size[geom])
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            return _mesh(model, int(model.geom_dataid[geom]))
        case mujoco.mjtGeom.mjGEOM_BOX:
            return _box(size)
        case mujoco.mjtGeom.mjGEOM_CYLINDER:
            return _revolve([(0, 1), (1, 1), (1, 1), (1, -1), (1, -1), (0, -1)], [2, 2, 0, 0, -2, -2], size[[0, 0, 1]])
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return _ellipsoid(size[[0, 0, 0]])
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            return _ellipsoid(size)
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            return _capsule(float(size[0]), float(size[1]))
    raise MemobenchError(
        f"geom {model.geom(geom).name!r} is a {kind.name.removeprefix('mjGEOM_').lower()}, which is not drawn; make "
        "what is seen of boxes, cylinders, spheres, ellipsoids, capsules and meshes"
    )


def _mesh(model: mujoco.MjModel, mesh: int) -> Triangles:
    """Return a mesh's triangles, one vertex for each combination of point, normal and texture coordinate."""
    face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    point, normal = int(model.mesh_vertadr[mesh]), int(model.mesh_normaladr[mesh])
    uv = int(model.mesh_texcoordadr[mesh])
    corners = np.stack(
        [
            model.mesh_face[face : face + faces].ravel(),
            model.mesh_facenormal[face : face + faces].ravel(),
            model.mesh_facetexcoord[face : face + faces].ravel() if uv >= 0 else np.zeros(3 * faces, np.int32),
        ],
        axis=1,
    )
    unique, index = _unique_in_order(corners)
    coordinates = model.mesh_texcoord[uv + unique[:, 2]] if uv >= 0 else np.zeros((len(unique), 2))
    return (
        model.mesh_vert[point + unique[:, 0]],
        model.mesh_normal[normal + unique[:, 1]],
        coordinates,
        index.reshape(-1, 3),
    )


def _unique_in_order(rows: NDArray[np.integer]) -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    """Return the distinct rows by first use, and where each row went: neighbours in use are neighbours in memory."""
    _, first, inverse = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rows[first[order]], rank[inverse.reshape(-1)]


def _box(size: NDArray[np.floating]) -> Triangles:
    positions: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    triangles: list[tuple[int, int, int]] = []
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for axis in range(3):
        for side in (-1, 1):
            corners = np.zeros((4, 3))
            corners[:, axis] = side
            corners[:, [(axis + 1) % 3, (axis + 2) % 3]] = square[:: int(side)]
            normal = np.zeros(3)
            normal[axis] = side
            start = 4 * len(positions)
            positions.append(corners * size)
            normals.append(np.tile(normal, (4, 1)))
            triangles += [(start, start + 1, start + 2), (start, start + 2, start + 3)]
    points = np.concatenate(positions)
    return points, np.concatenate(normals), np.zeros((len(points), 2)), np.array(triangles)


def _revolve(profile: list[tuple[float, float]], slopes: list[float], size: NDArray[np.floating]) -> Triangles:
    """Turn a profile of (radius, z) about z, top to bottom, and scale it.

    ``slopes`` gives the angle of the normal over the horizontal per point, in quarter turns of which ±2 stand for up
    and down.
    """
    angle = np.linspace(0, 2 * np.pi, ROUND, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    positions, normals = [], []
    for (radius, z), slope in zip(profile, slopes, strict=True):
        tilt = slope * np.pi / 4
        positions.append(np.column_stack([radius * around, np.full(ROUND, z)]))
        normals.append(np.column_stack([np.cos(tilt) * around, np.full(ROUND, np.sin(tilt))]))
    points = np.concatenate(positions) * size
    directions = np.concatenate(normals) / size
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    k = np.arange(ROUND)
    after = (k + 1) % ROUND
    triangles = []
    for ring in range(len(profile) - 1):
        upper, lower = ring * ROUND, (ring + 1) * ROUND
        triangles.append(np.column_stack([upper + k, lower + k, lower + after]))
        triangles.append(np.column_stack([upper + k, lower + after, upper + after]))
    faces = np.concatenate(triangles)
    edges = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    whole = np.linalg.norm(np.cross(*edges), axis=1) > 1e-14  # rings that lie in each other leave no face
    return points, directions, np.zeros((len(points), 2)), faces[whole]


def _ellipsoid(size: NDArray[np.floating]) -> Triangles:
    tilt = np.linspace(1, -1, ROUND // 2 + 1) * np.pi / 2
    return _revolve([(float(np.cos(t)), float(np.sin(t))) for t in tilt], [float(t / (np.pi / 4)) for t in tilt], size)


def _capsule(radius: float, half_length: float) -> Triangles:
    tilt = np.linspace(1, 0, ROUND // 4 + 1) * np.pi / 2
    upper = [(radius * float(np.cos(t)), half_length + radius * float(np.sin(t))) for t in tilt]
    slopes = [float(t / (np.pi / 4)) for t in tilt]
    lower = [(r, -z) for r, z in reversed(upper)]
    return _revolve(upper + lower, slopes + [-slope for slope in reversed(slopes)], np.ones(3))


def disc() -> Triangles:
    """Return a flat cylinder of radius 1 and height 2, top and side: the shape of a highlight."""
    return _revolve([(0, 1), (1, 1), (1, 1), (1, -1)], [2, 2, 0, 0], np.ones(3))
