"""Triangulate MuJoCo's geoms in their own frames: primitives, meshes and height fields."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.compiled import compiled
from mujoco_raster.errors import RasterError

ROUND_SIDES = 32
"""Sides of cylinders and spheres."""
MIN_NORMAL_COSINE = 0.8
"""Smallest cosine between vertex and face normal of a smooth corner; otherwise MuJoCo uses the face normal."""
INFINITE_PLANE_FACTOR = 1.05
"""Half side of an infinite plane, in units of the far clipping distance."""
MAX_PLANE_CELLS, COARSE_PLANE_CELLS = 200, 40
"""Maximum number of cells per side of a plane, as in MuJoCo's renderer, and of a coarse one."""

Triangles = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating], NDArray[np.integer]]
"""Positions (N, 3), normals (N, 3), texture coordinates (N, 2), triangles (M, 3)."""


def triangles_of(
    model: mujoco.MjModel, geom: int, meshes: Mapping[str, Triangles] | None = None, *, coarse: bool = False
) -> Triangles:
    """Return a geom's triangles in its own frame.

    Args:
        model: compiled scene.
        geom: id of the geom.
        meshes: replacements of the model's meshes by name.
        coarse: whether a plane has at most `COARSE_PLANE_CELLS` cells per side.
    """
    size = np.asarray(model.geom_size[geom])
    match mujoco.mjtGeom(int(model.geom_type[geom])):
        case mujoco.mjtGeom.mjGEOM_MESH | mujoco.mjtGeom.mjGEOM_SDF:
            return _named_mesh(model, int(model.geom_dataid[geom]), meshes or {})
        case mujoco.mjtGeom.mjGEOM_HFIELD:
            return _height_field(model, int(model.geom_dataid[geom]))
        case mujoco.mjtGeom.mjGEOM_PLANE:
            endless = INFINITE_PLANE_FACTOR * float(model.vis.map.zfar * model.stat.extent)
            return _plane(size, endless, COARSE_PLANE_CELLS if coarse else MAX_PLANE_CELLS)
        case kind:
            return primitive(int(kind), size)


def primitive(kind: int, size: NDArray[np.floating]) -> Triangles:
    """Return a box, cylinder, sphere, ellipsoid or capsule in its own frame.

    Args:
        kind: `mujoco.mjtGeom` value.
        size: MuJoCo's sizes (3,), m.

    Raises:
        RasterError: the type has no such shape.
    """
    match mujoco.mjtGeom(kind):
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
    raise RasterError(
        f"the geom type {mujoco.mjtGeom(kind).name} is not drawn; use a primitive, a mesh or a height field"
    )


def _height_field(model: mujoco.MjModel, field: int) -> Triangles:
    """Return a height field's surface with smooth normals, on a box that reaches below it."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    half_x, half_y, top, bottom = (float(length) for length in model.hfield_size[field])
    start = int(model.hfield_adr[field])
    heights = np.asarray(model.hfield_data[start : start + rows * columns], np.float64).reshape(rows, columns) * top
    x, y = np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows)
    along_y, along_x = np.gradient(heights, y, x)
    grid = np.stack([*np.meshgrid(x, y), heights], axis=2)
    normals = np.stack([-along_x, -along_y, np.ones_like(heights)], axis=2)
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    uv = np.stack(np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows)), axis=2)
    first = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = [np.column_stack([first, first + 1, first + columns + 1])]
    faces += [np.column_stack([first, first + columns + 1, first + columns])]
    surface = grid.reshape(-1, 3), normals.reshape(-1, 3), uv.reshape(-1, 2), np.concatenate(faces)
    borders = grid[0], grid[:, -1], grid[-1, ::-1], grid[::-1, 0]
    return _joined([surface, *(_wall(border, -bottom) for border in borders)])


def _wall(border: NDArray[np.float64], bottom: float) -> Triangles:
    """Return the vertical side below a border (N, 3), which runs to the right as seen from outside."""
    lower = border.copy()
    lower[:, 2] = bottom
    along = border[-1] - border[0]
    normal = np.array([along[1], -along[0], 0.0]) / max(float(np.hypot(along[0], along[1])), 1e-12)
    k = np.arange(len(border) - 1)
    low = k + len(border)
    faces = np.concatenate([np.column_stack([low, low + 1, k + 1]), np.column_stack([low, k + 1, k])])
    count = 2 * len(border)
    return np.concatenate([border, lower]), np.tile(normal, (count, 1)), np.zeros((count, 2)), faces


def _named_mesh(model: mujoco.MjModel, mesh: int, meshes: Mapping[str, Triangles]) -> Triangles:
    """Return a mesh, or its replacement, in the frame of the model's mesh, which is also its geom's.

    The compiler moves each mesh to its centre and principal axes, which differ for a mesh with more faces.
    """
    name = model.mesh(mesh).name
    if name not in meshes:
        return _mesh(model, mesh)
    here = _mesh_axes(model, mesh)
    if not model.mesh_pos[mesh].any() and (here == np.eye(3)).all():
        return meshes[name]
    points, normals, uv, triangles = meshes[name]
    return (points - model.mesh_pos[mesh]) @ here, normals @ here, uv, triangles


def welded(shape: Triangles) -> Triangles:
    """Return a shape in single precision without duplicate vertices; many files list one vertex per corner."""
    points, normals, uv, triangles = shape
    rows = np.concatenate([points, normals, uv], axis=1).astype(np.float32) + np.float32(0)  # no negative zeros
    unique, index = distinct_rows(rows.view(np.int32))
    rows = unique.view(np.float32)
    return rows[:, :3], rows[:, 3:6], rows[:, 6:], index[triangles].astype(np.int32)


def in_pieces(shape: Triangles, most: int) -> Triangles:
    """Return a shape sorted so that each block of up to ``most`` triangles is compact and has its own vertices."""
    points, normals, uv, triangles = shape
    middle = points[triangles].mean(axis=1)
    left: list[NDArray[np.int64]] = [np.arange(len(triangles))]
    order: list[NDArray[np.int64]] = []
    while left:
        mine = left.pop()
        if len(mine) > most:
            axis = np.ptp(middle[mine], axis=0).argmax()
            mine = mine[np.argsort(middle[mine, axis], kind="stable")]
            half = (len(mine) + most) // (2 * most) * most
            left += [mine[half:], mine[:half]]
        else:
            order.append(np.sort(mine))
    parts = [np.unique(triangles[mine], return_inverse=True) for mine in order]
    starts = np.cumsum([0, *(len(used) for used, _ in parts)])
    used = np.concatenate([used for used, _ in parts])
    moved = [index.reshape(-1, 3) + start for (_, index), start in zip(parts, starts, strict=False)]
    return points[used], normals[used], uv[used], np.concatenate(moved).astype(np.int32)


def pieces_of(shape: Triangles, most: int) -> Iterator[Triangles]:
    """Yield consecutive blocks of ``most`` triangles of a shape; see `in_pieces`."""
    points, normals, uv, triangles = shape
    for start in range(0, len(triangles), most):
        mine = triangles[start : start + most]
        first, end = int(mine.min()), int(mine.max()) + 1
        yield points[first:end], normals[first:end], uv[first:end], mine - first


def _mesh_axes(model: mujoco.MjModel, mesh: int) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from the frame of a compiled mesh to its file's."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.mesh_quat[mesh])
    return axes.reshape(3, 3)


def _mesh(model: mujoco.MjModel, mesh: int) -> Triangles:
    """Return a mesh's triangles with one vertex per combination of point, normal and texture coordinate."""
    face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    point, normal = int(model.mesh_vertadr[mesh]), int(model.mesh_normaladr[mesh])
    uv = int(model.mesh_texcoordadr[mesh])
    points = model.mesh_face[face : face + faces]
    normals = model.mesh_normal[normal : normal + int(model.mesh_normalnum[mesh])]
    normal_of = model.mesh_facenormal[face : face + faces]
    if uv < 0:  # a mesh with texture coordinates has explicit normals
        a, b, c = (model.mesh_vert[point + points[:, corner]] for corner in range(3))
        flat = np.cross(b - a, c - a)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        edged = np.einsum("fcx,fx->fc", normals[normal_of], flat) < MIN_NORMAL_COSINE
        normal_of = np.where(edged, len(normals) + np.arange(faces)[:, None], normal_of)
        normals = np.concatenate([normals, flat])
    corners = np.stack(
        [
            points.ravel(),
            normal_of.ravel(),
            model.mesh_facetexcoord[face : face + faces].ravel() if uv >= 0 else np.zeros(3 * faces, np.int32),
        ],
        axis=1,
    )
    unique, index = distinct_rows(corners)
    coordinates = model.mesh_texcoord[uv + unique[:, 2]] if uv >= 0 else np.zeros((len(unique), 2))
    return model.mesh_vert[point + unique[:, 0]], normals[unique[:, 1]], coordinates, index.reshape(-1, 3)


def distinct_rows(rows: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the distinct rows in order of first use, and the index of each row in them."""
    index, first = np.empty((2, len(rows)), np.int32)
    distinct = _find_distinct(rows, index, first)
    return rows[first[:distinct]], index


@compiled
def _find_distinct(rows: Any, index: Any, first: Any) -> Any:
    """Write the index of each row among the distinct ones, and the first row of each; return their number."""
    size = 1
    while size < 2 * rows.shape[0]:
        size *= 2
    table = np.full(size, -1, np.int32)  # hash table with open addressing
    distinct = 0
    for i in range(rows.shape[0]):
        key = np.uint64(0)
        for k in range(rows.shape[1]):
            key = (key ^ np.uint64(rows[i, k])) * np.uint64(0x9E3779B97F4A7C15)
            key ^= key >> np.uint64(32)
        slot = key & np.uint64(size - 1)
        while table[slot] >= 0 and (rows[first[table[slot]]] != rows[i]).any():
            slot = (slot + np.uint64(1)) & np.uint64(size - 1)
        if table[slot] < 0:
            table[slot], first[distinct] = distinct, i
            distinct += 1
        index[i] = table[slot]
    return distinct


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


def box_cells(model: mujoco.MjModel, geom: int) -> Triangles:
    """Return a box with sides subdivided as in MuJoCo, because light is computed at vertices."""
    points, normals, *_ = _box(np.asarray(model.geom_size[geom]))
    sides = [_cells(points[k : k + 4], normals[k], model.vis.quality.numquads) for k in range(0, len(points), 4)]
    return _joined(sides)


def _plane(size: NDArray[np.floating], endless: float, most: int) -> Triangles:
    """Return a subdivided plane from half sides and cell size; a half side of 0 is infinite."""
    x, y = np.where(size[:2] > 0, size[:2], endless)
    corners = np.array([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)])
    cells = int(np.ceil(max(x, y) / max(float(size[2]), 1e-9))) + 1
    return _cells(corners, np.array([0.0, 0.0, 1.0]), min(cells, most))


def _cells(corners: NDArray[np.floating], normal: NDArray[np.floating], cells: int) -> Triangles:
    """Cut a rectangle of four corners (4, 3) into cells × cells rectangles of two triangles."""
    steps = np.linspace(0, 1, cells + 1)
    across, along = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps, indexing="ij"))
    points = corners[0] + across * (corners[1] - corners[0]) + along * (corners[3] - corners[0])
    k = np.arange(cells * cells)
    first = k // cells * (cells + 1) + k % cells
    triangles = [
        np.column_stack([first, first + cells + 1, first + cells + 2]),
        np.column_stack([first, first + cells + 2, first + 1]),
    ]
    return points, np.tile(normal, (len(points), 1)), np.zeros((len(points), 2)), np.concatenate(triangles)


def _joined(shapes: list[Triangles]) -> Triangles:
    starts = np.cumsum([0, *(len(points) for points, *_ in shapes)])
    points, normals, uv = (np.concatenate([shape[k] for shape in shapes]) for k in range(3))
    triangles = np.concatenate([shape[3] + start for shape, start in zip(shapes, starts, strict=False)])
    return points, normals, uv, triangles


def _revolve(profile: list[tuple[float, float]], slopes: list[float], size: NDArray[np.floating]) -> Triangles:
    """Revolve a profile of (radius, z) about z, from top to bottom, and scale it.

    ``slopes``: angle of the normal above the horizontal per point, in units of 45°; ±2 is up and down.
    """
    angle = np.linspace(0, 2 * np.pi, ROUND_SIDES, endpoint=False)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    positions, normals = [], []
    for (radius, z), slope in zip(profile, slopes, strict=True):
        tilt = slope * np.pi / 4
        positions.append(np.column_stack([radius * around, np.full(ROUND_SIDES, z)]))
        normals.append(np.column_stack([np.cos(tilt) * around, np.full(ROUND_SIDES, np.sin(tilt))]))
    points = np.concatenate(positions) * size
    directions = np.concatenate(normals) / size
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    k = np.arange(ROUND_SIDES)
    after = (k + 1) % ROUND_SIDES
    triangles = []
    for ring in range(len(profile) - 1):
        upper, lower = ring * ROUND_SIDES, (ring + 1) * ROUND_SIDES
        triangles.append(np.column_stack([upper + k, lower + k, lower + after]))
        triangles.append(np.column_stack([upper + k, lower + after, upper + after]))
    faces = np.concatenate(triangles)
    edges = points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]]
    whole = np.linalg.norm(np.cross(*edges), axis=1) > 1e-14  # drop degenerate faces between coincident rings
    return points, directions, np.zeros((len(points), 2)), faces[whole]


def _ellipsoid(size: NDArray[np.floating]) -> Triangles:
    tilt = np.linspace(1, -1, ROUND_SIDES // 2 + 1) * np.pi / 2
    return _revolve([(float(np.cos(t)), float(np.sin(t))) for t in tilt], [float(t / (np.pi / 4)) for t in tilt], size)


def _capsule(radius: float, half_length: float) -> Triangles:
    tilt = np.linspace(1, 0, ROUND_SIDES // 4 + 1) * np.pi / 2
    upper = [(radius * float(np.cos(t)), half_length + radius * float(np.sin(t))) for t in tilt]
    slopes = [float(t / (np.pi / 4)) for t in tilt]
    lower = [(r, -z) for r, z in reversed(upper)]
    return _revolve(upper + lower, slopes + [-slope for slope in reversed(slopes)], np.ones(3))


def disc() -> Triangles:
    """Return the shape of a highlight: top and side of a cylinder of radius 1 and height 2."""
    return _revolve([(0, 1), (1, 1), (1, 1), (1, -1)], [2, 2, 0, 0], np.ones(3))
