"""Collect the geoms of a model as one list of triangles.

Each geom is a row of the list. A small table with pose, colour and material of each row is updated per frame;
the list is built once per scene.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.shapes import (
    Triangles,
    box_cells,
    disc,
    distinct_rows,
    in_pieces,
    pieces_of,
    primitive,
    triangles_of,
)
from mujoco_raster.textures import cube_coordinates, flat_coordinates, layers_of, sky_box, skybox_of, texture_of

DEFAULT_GROUPS = (0, 1, 2)
"""Geom groups that MuJoCo's renderer draws by default."""
TABLE_LINES = 5
"""Lines of four numbers per row of the table: pose (3), colour, material."""

POSITION, ROW, RECORD = 5, 6, 8
"""Columns of a vertex that are integers, and the number of columns."""
MAX_PIECE_TRIANGLES = 2000
"""Largest number of mesh triangles per row; rows outside the image are skipped."""

_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], dtype=np.float32)
"""A geom of this colour takes its material's colour, as in MuJoCo."""
_NO_MATERIAL = (0.5, 64.0, 0.0, 0.0)
"""MuJoCo's specular, shininess exponent and emission of a geom without material, and no texture layer."""

HIGHLIGHTS = 16
"""Maximum number of highlights in a frame."""
_DISC = (0.0, 1.0, 0.3, 0)  # material and layer of a highlight

Floats = NDArray[np.float32]
Image = NDArray[np.uint8]
"""Image (height, width, 3), first row on top."""


@dataclass(frozen=True)
class DrawList:
    """Triangles of a scene, sorted by rows.

    A row is a geom, one side of a geom with a cube texture, or one piece of a large mesh; rows of sites, of the six
    sides of the sky and of the discs of highlights follow.

    Attributes:
        points: (P, 3) positions in the frames of the rows; first_point: (rows + 1,).
        vertices: (N, 8), normals in the frames of the rows (3) and texture coordinates (2); as integers, the position
            and the row in columns `POSITION` and `ROW`.
        triangles: (M, 3) vertex indices, counter-clockwise from outside.
        geoms: (rows of geoms,) geom ids.
        sites: (rows of sites,) site ids.
        sky: number of rows of the sky, 6 or 0.
        still: number of static rows (no joint between them and the world), which come first.
        texels: textures, see `textures.layers_of`.
        materials: (rows, 4) specular, shininess exponent, emission, layer.
        mirror: reflecting geom, if any.
    """

    points: Floats
    first_point: NDArray[np.int32]
    vertices: Floats
    triangles: NDArray[np.int32]
    geoms: NDArray[np.int64]
    sites: NDArray[np.int64]
    sky: int
    still: int
    texels: NDArray[np.int32]
    materials: Floats
    mirror: Mirror | None = None

    @property
    def origin(self) -> NDArray[np.int32]:
        """The memory of ``vertices`` as integers, (N, 8)."""
        return self.vertices.view(np.int32)

    @property
    def objects(self) -> int:
        """Number of rows of geoms and sites."""
        return len(self.geoms) + len(self.sites)

    def fill(self, table: Floats, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        """Write poses, colours and materials of the present state into a table (rows, TABLE_LINES, 4)."""
        geoms = table[: len(self.geoms)]
        geoms[:, :3, :3] = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        geoms[:, :3, 3] = data.geom_xpos[self.geoms]
        geoms[:, 3] = _colours(model, model.geom_rgba[self.geoms], model.geom_matid[self.geoms])
        table[:, 4] = self.materials
        if len(self.sites):
            sites = table[len(self.geoms) : self.objects]
            sites[:, :3, :3] = data.site_xmat[self.sites].reshape(-1, 3, 3)
            sites[:, :3, 3] = data.site_xpos[self.sites]
            sites[:, 3] = _colours(model, model.site_rgba[self.sites], model.site_matid[self.sites])


def build_draw_list(
    model: mujoco.MjModel,
    meshes: Mapping[str, Triangles] | None = None,
    groups: Sequence[int] = DEFAULT_GROUPS,
    site_groups: Sequence[int] = (),
    *,
    images: Mapping[str, Image] | None = None,
    sky: bool = False,
    coarse: bool = False,
) -> DrawList:
    """Collect the geoms and sites of some groups, with sharp mesh edges as MuJoCo's renderer.

    Args:
        model: compiled scene.
        meshes: replacements of the scene's meshes by name.
        groups: geom groups to draw.
        site_groups: site groups to draw.
        images: replacements of the scene's textures by name.
        sky: whether to draw the model's skybox, if it has one.
        coarse: whether to divide planes and boxes, at whose corners light is computed, only as far as LIBERO's scenes
            show it, and to draw the lower id where two geoms coincide; MuJoCo draws the higher one.
    """
    visual = np.flatnonzero(np.isin(model.geom_group, groups))
    moves = model.body_weldid[model.geom_bodyid[visual]] != 0
    texels, layer_of = layers_of(model, images, sky=sky)
    order = 1 if coarse else -1  # the first of equally near triangles is kept
    ids = [*visual[~moves][::order].tolist(), *visual[moves][::order].tolist()]
    parts = [(geom, *part) for geom in ids for part in _textured(model, geom, meshes, layer_of, coarse)]
    rows = np.array([geom for geom, _, _ in parts], dtype=np.int64)
    materials = [(*_material(model, int(model.geom_matid[geom])), layer) for geom, layer, _ in parts]
    sites = np.flatnonzero(np.isin(model.site_group, site_groups))
    for site in sites.tolist():
        parts.append((site, 0, primitive(int(model.site_type[site]), model.site_size[site])))
        materials.append((*_material(model, int(model.site_matid[site])), 0))
    skybox = layer_of.get(skybox_of(model), ()) if sky else ()
    for side, layer in enumerate(skybox):
        parts.append((side, layer, sky_box(side)))
        materials.append((0.0, 0.0, 1.0, layer))  # light of its own
    parts += [(0, 0, disc())] * HIGHLIGHTS
    materials += [_DISC] * HIGHLIGHTS
    ends = np.cumsum([0, *(len(shape[0]) for _, _, shape in parts)]).tolist()
    corners, vertices = np.empty((ends[-1], 4), np.int32), np.zeros((ends[-1], RECORD), np.float32)
    for row, (_, _, shape) in enumerate(parts):
        mine = slice(ends[row], ends[row + 1])
        corners[mine, 0], corners.view(np.float32)[mine, 1:] = row, shape[0]
        vertices[mine, :3], vertices[mine, 3:POSITION] = shape[1], shape[2]
    points, point = distinct_rows(corners)
    vertices.view(np.int32)[:, POSITION], vertices.view(np.int32)[:, ROW] = point, corners[:, 0]
    triangles = [shape[3] + start for (_, _, shape), start in zip(parts, ends, strict=False)]
    bodies = model.geom_bodyid[rows]
    return DrawList(
        points[:, 1:].view(np.float32),
        np.searchsorted(points[:, 0], np.arange(len(parts) + 1)).astype(np.int32),
        vertices,
        np.concatenate(triangles, dtype=np.int32, casting="same_kind"),
        rows,
        sites,
        len(skybox),
        int((model.body_weldid[bodies] == 0).sum()),
        texels,
        np.array(materials, dtype=np.float32),
        find_mirror(model, rows),
    )


def _colours(model: mujoco.MjModel, rgba: Floats, material: NDArray[np.int32]) -> Floats:
    """Return the colours (N, 4) of geoms or sites: their own if set, else their material's."""
    plain = (material >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=1)
    return np.where(plain[:, None], model.mat_rgba[np.maximum(material, 0)], rgba) if model.nmat else rgba


def _material(model: mujoco.MjModel, material: int) -> tuple[float, float, float]:
    """Return specular, shininess exponent and emission; MuJoCo's defaults without material."""
    if material < 0:
        return _NO_MATERIAL[:3]
    exponent = 128.0 * float(model.mat_shininess[material])
    return float(model.mat_specular[material]), exponent, float(model.mat_emission[material])


def _textured(
    model: mujoco.MjModel,
    geom: int,
    meshes: Mapping[str, Triangles] | None,
    layer_of: dict[int, tuple[int, ...]],
    coarse: bool,
) -> Iterator[tuple[int, Triangles]]:
    """Yield texture layers of a geom and their triangles with texture coordinates."""
    material = int(model.geom_matid[geom])
    texture = texture_of(model, material)
    layers = layer_of.get(texture, (0,))
    kind, mesh = int(model.geom_type[geom]), int(model.geom_dataid[geom])
    is_mesh = kind == mujoco.mjtGeom.mjGEOM_MESH.value
    # MuJoCo computes light at vertices and subdivides boxes, which is visible with textures and spots, and where two
    # boxes coincide.
    fine = kind == mujoco.mjtGeom.mjGEOM_BOX.value and (not coarse or texture in layer_of or _has_spots(model))
    shape = box_cells(model, geom) if fine else triangles_of(model, geom, meshes, coarse=coarse)
    mapped = is_mesh and (bool(shape[2].any()) or model.mesh_texcoordadr[mesh] >= 0)
    if is_mesh and len(shape[3]) > MAX_PIECE_TRIANGLES and model.mesh(mesh).name not in (meshes or {}):
        shape = in_pieces(shape, MAX_PIECE_TRIANGLES)
    if texture not in layer_of or mapped:
        yield from ((layers[0], piece) for piece in (pieces_of(shape, MAX_PIECE_TRIANGLES) if is_mesh else (shape,)))
    elif len(layers) == 1:
        yield layers[0], flat_coordinates(model, geom, shape)
    else:
        for side, part in cube_coordinates(model, geom, shape):
            yield layers[side], part


def _has_spots(model: mujoco.MjModel) -> bool:
    return bool(np.any(model.light_type[model.light_active != 0] != mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value))


# --- reflection: MuJoCo mirrors a scene in the upper side of the first reflecting box or plane ---

_REFLECTING = (mujoco.mjtGeom.mjGEOM_PLANE.value, mujoco.mjtGeom.mjGEOM_BOX.value)


@dataclass(frozen=True)
class Mirror:
    """A reflecting geom.

    Attributes:
        rows: rows of the geom in the draw list.
        height: height of the upper side in the geom's frame, m.
        reflectance: reflected share of colours, 0 to 1.
    """

    rows: NDArray[np.int64]
    height: float
    reflectance: float

    def plane(self, table: Floats) -> tuple[Floats, Floats]:
        """Return a point of the upper side (3,) and its normal (3,) in the world."""
        pose = table[self.rows[0]]
        return pose[:3, 3] + np.float32(self.height) * pose[:3, 2], pose[:3, 2]


def find_mirror(model: mujoco.MjModel, geoms: NDArray[np.int64]) -> Mirror | None:
    """Return the first reflecting geom of a draw list's rows, None without one."""
    for geom in np.unique(geoms):
        material = int(model.geom_matid[geom])
        if material < 0 or model.geom_type[geom] not in _REFLECTING or model.mat_reflectance[material] <= 0:
            continue
        box = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX.value
        height = float(model.geom_size[geom, 2]) if box else 0.0
        return Mirror(np.flatnonzero(geoms == geom), height, float(model.mat_reflectance[material]))
    return None
