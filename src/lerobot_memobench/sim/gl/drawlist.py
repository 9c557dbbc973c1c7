"""What a camera can see of a model, as one list of triangles.

MuJoCo draws geom by geom, each with its own state changes, and a shadow makes it draw everything three times. Here
all visual geoms of a scene become one vertex array; where each stands and what it is made of is a small table that
is sent anew for every frame. A frame is then three draw calls, whatever the number of geoms.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError

VISUAL_GROUP = 1
"""Geoms of this group are seen; the others are for contacts."""
LAYER_SIZE = 512
"""Side to which textures are brought, pixels: the largest of the project's own."""
ROWS = 5
"""Texels per geom in the table: three rows of the pose, colour, material."""
ROUND = 32
"""Sides of cylinders and spheres."""
LEAST_AGREEMENT = 0.8
"""Cosine below which MuJoCo's renderer draws a corner of a mesh with its face's normal: there is an edge."""

_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
"""A geom of this colour shows its material's, as in MuJoCo."""

VERTEX = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("uv", "<f4", 2), ("geom", "<f4")])

Floats = NDArray[np.float32]
Triangles = tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating], NDArray[np.integer]]
"""Positions (N, 3), normals (N, 3), texture coordinates (N, 2), triangles (M, 3)."""


@dataclass(frozen=True)
class DrawList:
    """The triangles of a scene.

    ``vertices``: structured array of `VERTEX`, in the frames of their geoms. ``indices``: three per triangle, in the
    order of ``geoms``, the model ids of the rows of the table. ``still`` and ``moving``: the indices again of geoms
    that cast shadows, without and with a joint between them and the world; ``still_rows``: rows of the former.
    ``layers``: (L, LAYER_SIZE, LAYER_SIZE, 3) textures, the first one white.
    """

    vertices: NDArray[np.void]
    indices: NDArray[np.uint32]
    geoms: NDArray[np.int64]
    still: NDArray[np.uint32]
    moving: NDArray[np.uint32]
    still_rows: NDArray[np.int64]
    layers: NDArray[np.uint8]
    materials: Floats

    def fill(self, table: Floats, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write poses, colours and materials of the present state into a table, (geoms, ROWS, 4)."""
        table[:, :3, :3] = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        table[:, :3, 3] = data.geom_xpos[self.geoms]
        table[:, 3] = colours(model, self.geoms)
        table[:, 4] = self.materials


def build_draw_list(
    model: mujoco.MjModel,
    background: tuple[str, ...] = (),
    shadowless: tuple[str, ...] = (),
    finer: mujoco.MjModel | None = None,
) -> DrawList:
    """Collect the visual geoms of a model.

    Args:
        model: a compiled scene.
        background: bodies to draw last, in this order, since they fill what the others leave free.
        shadowless: bodies that cast no shadow.
        finer: a model whose meshes are drawn in place of the scene's of the same names.

    Raises:
        MemobenchError: for a visual geom of a shape that is not drawn here.
    """
    geoms = np.array(_visual_geoms(model, background), dtype=np.int64)
    parts, indices, start = [], [np.zeros(0, np.uint32)], 0
    for row, geom in enumerate(geoms.tolist()):
        positions, normals, uv, triangles = triangles_of(model, geom, finer)
        part = np.zeros(len(positions), dtype=VERTEX)
        part["position"], part["normal"], part["uv"], part["geom"] = positions, normals, uv, row
        parts.append(part)
        indices.append((triangles + start).astype(np.uint32).ravel())
        start += len(part)
    bodies = model.geom_bodyid[geoms]
    casting = ~np.isin(bodies, _bodies(model, shadowless))
    still = model.body_weldid[bodies] == 0
    layers, layer_of = _layers(model)

    def indices_of(rows: NDArray[np.bool_]) -> NDArray[np.uint32]:
        return np.concatenate([indices[0], *(indices[1 + row] for row in np.flatnonzero(rows))])

    return DrawList(
        np.concatenate(parts) if parts else np.zeros(0, VERTEX),
        np.concatenate(indices),
        geoms,
        indices_of(casting & still),
        indices_of(casting & ~still),
        np.flatnonzero(casting & still),
        layers,
        _materials(model, geoms, layer_of),
    )


def _visual_geoms(model: mujoco.MjModel, background: tuple[str, ...]) -> list[int]:
    """Return the ids of visual geoms in the order in which they are drawn."""
    place = {body: k for k, body in enumerate(_bodies(model, background))}
    visual = [geom for geom in range(model.ngeom) if model.geom_group[geom] == VISUAL_GROUP]
    return sorted(visual, key=lambda geom: place.get(int(model.geom_bodyid[geom]), -1))


def _bodies(model: mujoco.MjModel, names: tuple[str, ...]) -> list[int]:
    """Return the ids of those bodies that the model has."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name) for name in names]
    return [body for body in ids if body >= 0]


def colours(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> Floats:
    """Return the colours (N, 4) of geoms: their own where set, else their material's."""
    rgba = model.geom_rgba[geoms]
    material = model.geom_matid[geoms]
    plain = (material >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=1)
    return np.where(plain[:, None], model.mat_rgba[np.maximum(material, 0)], rgba) if model.nmat else rgba


def _materials(model: mujoco.MjModel, geoms: NDArray[np.int64], layer_of: dict[int, int]) -> Floats:
    """Return specular, shininess exponent, emission and texture layer (N, 4); MuJoCo's defaults without material."""
    rows = np.tile(np.array([0.5, 64.0, 0.0, 0.0], dtype=np.float32), (len(geoms), 1))
    for row, geom in zip(rows, geoms, strict=True):
        material = int(model.geom_matid[geom])
        if material >= 0:
            texture = int(model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value])
            row[:] = (
                model.mat_specular[material],
                128.0 * model.mat_shininess[material],
                model.mat_emission[material],
                layer_of.get(texture, 0),
            )
    return rows


def _layers(model: mujoco.MjModel) -> tuple[NDArray[np.uint8], dict[int, int]]:
    """Return the two-dimensional textures at one size, and texture id → layer; layer 0 is white."""
    from PIL import Image

    layers: list[NDArray[np.uint8]] = [np.full((LAYER_SIZE, LAYER_SIZE, 3), 255, dtype=np.uint8)]
    layer_of: dict[int, int] = {}
    for texture in range(model.ntex):
        if model.tex_type[texture] != mujoco.mjtTexture.mjTEXTURE_2D or model.tex_nchannel[texture] != 3:
            continue
        height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
        start = int(model.tex_adr[texture])
        pixels = np.asarray(model.tex_data[start : start + 3 * height * width]).reshape(height, width, 3)
        layer_of[texture] = len(layers)
        # At its own size this leaves every pixel as it is.
        resized = Image.fromarray(pixels).resize((LAYER_SIZE, LAYER_SIZE), Image.Resampling.BICUBIC)
        layers.append(np.asarray(resized))
    return np.stack(layers), layer_of


# --- the triangles of MuJoCo's shapes: meshes, boxes, cylinders, spheres, ellipsoids, capsules ---


def triangles_of(model: mujoco.MjModel, geom: int, finer: mujoco.MjModel | None = None) -> Triangles:
    """Return a geom's triangles in its own frame.

    Args:
        model: a compiled scene.
        geom: its id.
        finer: a model whose mesh of the same name is taken, where it has one.

    Raises:
        MemobenchError: for a shape that is not drawn here.
    """
    kind = mujoco.mjtGeom(int(model.geom_type[geom]))
    size = np.asarray(model.geom_size[geom])
    match kind:
        case mujoco.mjtGeom.mjGEOM_MESH:
            return _named_mesh(model, int(model.geom_dataid[geom]), finer or model)
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


def _named_mesh(model: mujoco.MjModel, mesh: int, source: mujoco.MjModel) -> Triangles:
    """Return another model's mesh of the same name in the frame of this model's mesh, which is also its geom's.

    The compiler moves every mesh into its own centre and principal axes, and a mesh of more faces has others.
    """
    other = mujoco.mj_name2id(source, mujoco.mjtObj.mjOBJ_MESH, model.mesh(mesh).name)
    if source is model or other < 0:
        return _mesh(model, mesh)
    here, there = _mesh_axes(model, mesh), _mesh_axes(source, other)
    points, normals, uv, triangles = _mesh(source, other, LEAST_AGREEMENT)
    in_file = points @ there.T + source.mesh_pos[other]
    return (in_file - model.mesh_pos[mesh]) @ here, normals @ there.T @ here, uv, triangles


def _mesh_axes(model: mujoco.MjModel, mesh: int) -> NDArray[np.float64]:
    """Return the rotation (3, 3) from the frame of a compiled mesh to its file's."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.mesh_quat[mesh])
    return axes.reshape(3, 3)


def _mesh(model: mujoco.MjModel, mesh: int, agreement: float = -np.inf) -> Triangles:
    """Return a mesh's triangles, one vertex for each combination of point, normal and texture coordinate.

    Args:
        model: a compiled model.
        mesh: its id.
        agreement: cosine to a face's own normal below which a point's mean normal is not taken.
    """
    face, faces = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    point, normal = int(model.mesh_vertadr[mesh]), int(model.mesh_normaladr[mesh])
    uv = int(model.mesh_texcoordadr[mesh])
    points = model.mesh_face[face : face + faces]
    normals = model.mesh_normal[normal : normal + int(model.mesh_normalnum[mesh])]
    normal_of = model.mesh_facenormal[face : face + faces]
    if uv < 0 and agreement > -1:  # a mesh with texture coordinates comes with normals of its own
        a, b, c = (model.mesh_vert[point + points[:, corner]] for corner in range(3))
        flat = np.cross(b - a, c - a)
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-12)
        edged = np.einsum("fcx,fx->fc", normals[normal_of], flat) < agreement
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
    unique, index = _unique_in_order(corners)
    coordinates = model.mesh_texcoord[uv + unique[:, 2]] if uv >= 0 else np.zeros((len(unique), 2))
    return model.mesh_vert[point + unique[:, 0]], normals[unique[:, 1]], coordinates, index.reshape(-1, 3)


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
