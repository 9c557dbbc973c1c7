"""Keep what is seen of LIBERO's world in the user's cache folder: meshes with each vertex once, textures at one size.

Its files hold 80 MB, which take seconds to read. Here each is read once; later processes compile a model in which boxes
stand for meshes, and draw the meshes that are kept. Things of many faces are thinned; kitchen and arm are not.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.io import cache_folder, draft_of, file_hash
from lerobot_memobench.sim.raster.drawlist import PIECE, VISUAL_GROUP, DrawList, build_draw_list
from lerobot_memobench.sim.raster.shapes import Triangles, in_pieces, triangles_of, welded
from lerobot_memobench.sim.raster.textures import LAYER_SIZE, resized

Arrays = Mapping[str, NDArray[Any]]
"""What is kept of a file: a record of NumPy's, which is read in a third of the time of an archive of arrays."""
FORM = "7"
"""Of the kept files; another one for each change of what they hold."""
LEAST_THINNED, THINNED_TO = 6000, 4000
"""Triangles of meshes that are thinned, and to how many: things fill a thousandth of a picture each."""
LARGEST_THINNED = 0.5
"""Their largest size, m: what is larger stands still, and is drawn once per scene."""
AGREEMENT = 0.96
"""Cosine below which a corner of a thinned mesh has its face's normal: a few large faces show no rounded edge."""
STAND_IN = np.array([(x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)], dtype=np.float64)
STAND_IN_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""A box in place of a mesh; the compiler leaves it in the frame of its file."""


def drawn(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, DrawList]:
    """Return a scene to take poses and lights from, and what to draw of it.

    Args:
        spec: the scene with its visual geoms; it is changed.

    Raises:
        ValueError: MuJoCo cannot read a file.
    """
    seen = {geom.meshname for geom in spec.geoms if geom.group == VISUAL_GROUP}
    for mesh in spec.meshes:
        if mesh.name not in seen and mesh.file:
            _stand_in(mesh)
    files = [(_key(part), part) for part in [*spec.meshes, *spec.textures] if part.file]
    kept = {key: _read(key) for key, _ in files}
    missing = {key: part for key, part in files if kept[key] is None}
    if missing:
        whole = spec.copy().compile()
        kept |= {key: _keep(key, _content(whole, part)) for key, part in missing.items()}
    meshes = {}
    for key, part in files:
        arrays = kept[key]
        assert arrays is not None
        if isinstance(part, mujoco.MjsMesh):
            meshes[part.name] = arrays
            _stand_in(part)
        elif arrays["pixels"].size:
            _replace(part, arrays["pixels"])
    model = spec.compile()
    _set_frames(model, meshes)
    shapes = {name: _shape(arrays) for name, arrays in meshes.items()}
    return model, build_draw_list(model, meshes=shapes, as_mujoco=True)


# --- what is kept of a file ---


def _key(part: mujoco.MjsMesh | mujoco.MjsTexture) -> str:
    """Return a name for what is kept of a mesh or a texture, by all that it depends on."""
    scale = part.scale.tolist() if isinstance(part, mujoco.MjsMesh) else LAYER_SIZE
    facts = FORM, mujoco.__version__, file_hash(Path(part.file)), scale
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:24]


def _path(key: str) -> Path:
    return cache_folder() / "libero" / f"{key}.npy"


def _read(key: str) -> Arrays | None:
    with contextlib.suppress(OSError, ValueError, EOFError):  # there is none, or a damaged one
        kept: Arrays = np.load(_path(key), allow_pickle=False)[0]
        return kept
    return None


def _keep(key: str, arrays: Arrays) -> Arrays:
    """Write arrays where the folder takes them; without it each process reads LIBERO's files."""
    record = np.empty(1, [(name, array.dtype, array.shape) for name, array in arrays.items()])
    for name, array in arrays.items():
        record[name] = array
    path = _path(key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with draft_of(path) as draft:
            np.save(draft, record)
    return arrays


def _content(model: mujoco.MjModel, part: mujoco.MjsMesh | mujoco.MjsTexture) -> Arrays:
    """Return what is kept of a compiled mesh or texture; no pixels of a texture that is no square of three channels."""
    if isinstance(part, mujoco.MjsTexture):
        texture = model.tex(part.name)
        start, height, width = int(texture.adr[0]), int(texture.height[0]), int(texture.width[0])
        if texture.nchannel[0] != 3 or height != width:
            return {"pixels": np.zeros(0, np.uint8)}
        pixels = np.asarray(model.tex_data[start : start + 3 * height * width]).reshape(height, width, 3)
        return {"pixels": resized(pixels)}
    mesh = model.mesh(part.name).id
    shown = np.flatnonzero((model.geom_dataid == mesh) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value))
    frame = np.concatenate([model.mesh_pos[mesh], model.mesh_quat[mesh], model.geom_size[shown[0]]])
    material = model.geom_matid[shown[0]]
    textured = material >= 0 and model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value] >= 0
    shape = triangles_of(model, int(shown[0]), sharp=True)
    *vertices, triangles = in_pieces(welded(_thinned(shape) if textured else shape), PIECE)
    return {"frame": frame, "vertices": np.concatenate(vertices, axis=1), "triangles": triangles}


def _thinned(shape: Triangles) -> Triangles:
    """Return a thing's shape with few triangles where its picture is one piece; seams of the picture stay.

    Collapsed vertices take the coordinates and the normal of the nearest one of theirs.
    """
    points, normals, uv, triangles = shape
    if len(triangles) <= LEAST_THINNED or not uv.any() or np.ptp(points, axis=0).max() > LARGEST_THINNED:
        return shape
    import fast_simplification  # only the first picture on a machine needs it

    spots, _, spot_uv, same = welded((points, np.zeros_like(points), uv, np.arange(len(points))))
    smooth = np.zeros_like(spots)
    np.add.at(smooth, same, normals)
    faces = same[triangles]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, _, collapses = fast_simplification.simplify(
        spots, faces, target_count=THINNED_TO, agg=5, return_collapses=True, preserve_border=True
    )
    corners, thin, moved = fast_simplification.replay_simplification(spots, faces, collapses)
    off = np.linalg.norm(spots - corners[moved], axis=1)
    order = np.lexsort((-off, moved))  # the nearest one of each is written last
    nearest = np.zeros(len(corners), np.int64)
    nearest[moved[order]] = order
    flat = np.cross(corners[thin[:, 1]] - corners[thin[:, 0]], corners[thin[:, 2]] - corners[thin[:, 0]])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
    mean = smooth[nearest] / np.maximum(np.linalg.norm(smooth[nearest], axis=1, keepdims=True), 1e-20)
    edged = np.einsum("fcx,fx->fc", mean[thin], flat) < AGREEMENT
    normal = np.where(edged[..., None], flat[:, None], mean[thin]).reshape(-1, 3)
    return corners[thin.ravel()], normal, spot_uv[nearest][thin.ravel()], np.arange(thin.size).reshape(-1, 3)


def _shape(kept: Arrays) -> Triangles:
    vertices = kept["vertices"]
    return vertices[:, :3], vertices[:, 3:6], vertices[:, 6:], kept["triangles"]


# --- in place of files ---


def _stand_in(mesh: mujoco.MjsMesh) -> None:
    faces = [corner for a, b, c, d in STAND_IN_FACES for corner in (a, b, c, a, c, d)]
    mesh.file, mesh.scale = "", [1.0, 1.0, 1.0]
    mesh.uservert, mesh.userface = (0.01 * STAND_IN).ravel().tolist(), faces


def _replace(texture: mujoco.MjsTexture, pixels: NDArray[np.uint8]) -> None:
    texture.file, texture.nchannel = "", 3
    texture.height, texture.width = pixels.shape[:2]
    texture.data = pixels.tobytes()


def _set_frames(model: mujoco.MjModel, meshes: Mapping[str, Arrays]) -> None:
    """Give geoms of stand-ins the frames and sizes of the kept meshes: pictures are laid over them by these."""
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value):
        mesh = int(model.geom_dataid[geom])
        kept = meshes.get(model.mesh(mesh).name)
        if kept is None:
            continue
        position, quaternion, size = np.split(kept["frame"], (3, 7))
        model.mesh_pos[mesh], model.mesh_quat[mesh] = 0, (1, 0, 0, 0)  # a kept mesh lies in the frame of its geom
        offset, turn = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(offset, position, model.geom_quat[geom])
        mujoco.mju_mulQuat(turn, model.geom_quat[geom], quaternion)
        model.geom_pos[geom] += offset
        model.geom_quat[geom] = turn
        model.geom_size[geom] = size
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE.value
