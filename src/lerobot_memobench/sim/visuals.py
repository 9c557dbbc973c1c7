"""Cache the visual assets of scenes in the user's cache folder: welded meshes, textures at one size.

LIBERO's files have 80 MB and take seconds to read. Each is read once; later processes compile a model with box
placeholders and draw the cached meshes. Objects with many faces are simplified; kitchen and arm are not.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from lerobot_memobench.io import cache_folder, file_hash, write_file
from lerobot_memobench.jobs.threads import cores, sharing_processes
from lerobot_memobench.sim.asset import VISUAL_GROUP
from lerobot_memobench.sim.files import known_hashes, verified
from mujoco_raster.drawlist import MAX_PIECE_TRIANGLES, DrawList, build_draw_list
from mujoco_raster.shapes import Triangles, in_pieces, triangles_of, welded
from mujoco_raster.textures import LAYER_SIZE, pixels_of, resized

type Part = mujoco.MjsMesh | mujoco.MjsTexture
Arrays = dict[str, NDArray[Any]]
"""Cached content of a file."""
CACHE_FORMAT = "9"  # version of the cache files; increase it with each change of their content
MESH_SETTINGS = ("scale", "refpos", "refquat", "smoothnormal", "inertia")
TEXTURE_SETTINGS = ("type", "hflip", "vflip", "nchannel", "gridsize", "gridlayout")
"""Attributes of a file's mesh or texture on which cached content depends."""
THIN_ABOVE, THIN_TO = 6000, 4000
"""Number of triangles above which meshes are simplified, and the target; an object covers a thousandth of an image."""
SHARES = 8  # of missing files, read one after another in each thread; fewer take up to 0.4 GB more memory
_SIMPLIFYING = threading.Lock()  # the library keeps a mesh in global variables, without Python's lock
MAX_THINNED_SIZE = 0.5  # largest size of simplified meshes, m; larger ones are static and drawn once per scene
MIN_NORMAL_COSINE = 0.96  # smallest cosine between vertex and face normal of a smooth corner of a simplified mesh
PLACEHOLDER_POINTS = np.array([(x, y, z) for x in (-1, 1) for y in (-2, 2) for z in (-3, 3)], dtype=np.float64)
PLACEHOLDER_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
"""Box placeholder of a mesh; the compiler does not change its frame."""


def drawing_model(spec: mujoco.MjSpec) -> tuple[mujoco.MjModel, DrawList]:
    """Return a model for poses and lights, and the draw list of a scene with visual geoms; ``spec`` is modified.

    Raises:
        ValueError: MuJoCo cannot read a file.
    """
    drawn = {geom.meshname for geom in spec.geoms if geom.group == VISUAL_GROUP}
    for mesh in spec.meshes:
        if mesh.name not in drawn and mesh.file:
            _use_placeholder(mesh)
    parts = [part for part in [*spec.meshes, *spec.textures] if part.file]
    known = {str(path): known_hashes()[name] for name, path in verified().items()}
    files = [(part, _key(part, known.get(part.file))) for part in parts]
    contents = {key: _read_cache(key) for _, key in files}
    if missing := {key: part for part, key in files if contents[key] is None}:
        contents |= _read_files(spec, missing)
    for part, key in files:
        if contents[key]:
            _use_placeholder(part)
    named = [(part.name, contents[key] or {}) for part, key in files]
    meshes = {name: content for name, content in named if "frame" in content}
    shapes = {name: (c["position"], c["normal"], c["uv"], c["triangles"]) for name, c in meshes.items()}
    images = {name: content["pixels"] for name, content in named if "pixels" in content}
    model = spec.compile()
    _set_frames(model, meshes)
    return model, build_draw_list(model, shapes, (VISUAL_GROUP,), images=images, coarse=True)


def _read_files(spec: mujoco.MjSpec, missing: Mapping[str, Part]) -> dict[str, Arrays]:
    """Read and cache the files of some meshes and textures in threads; MuJoCo and NumPy release Python's lock."""

    def read(spec: mujoco.MjSpec, keys: Sequence[str]) -> dict[str, Arrays]:
        mine = {(type(missing[key]), missing[key].name) for key in keys}
        for part in [*spec.meshes, *spec.textures]:
            if part.file and (type(part), part.name) not in mine:
                _use_placeholder(part)
        model = spec.compile()
        mujoco.mj_clearCache(mujoco.mj_getCache())  # MuJoCo keeps up to 500 MB of files
        # A file may have changed since it was verified, so its content is cached under its present hash.
        return {key: _write_cache(_key(missing[key]), _extract(model, missing[key])) for key in keys}

    keys = sorted(missing, key=lambda key: os.path.getsize(missing[key].file), reverse=True)
    shares = [keys[k::SHARES] for k in range(min(SHARES, len(keys)))]
    with ThreadPoolExecutor(max(1, cores() // sharing_processes())) as pool:
        contents = [*pool.map(read, [spec.copy() for _ in shares], shares)]
    return {key: content for share in contents for key, content in share.items()}


# --- cache files ---


def _key(part: Part, file: str | None = None) -> str:
    """Return the name of the content of a mesh or texture, from its settings and the hash of its file."""
    names = MESH_SETTINGS if isinstance(part, mujoco.MjsMesh) else TEXTURE_SETTINGS
    settings = [np.asarray(getattr(part, name)).tolist() for name in names]
    facts = CACHE_FORMAT, mujoco.__version__, LAYER_SIZE, file or file_hash(Path(part.file)), settings
    return hashlib.sha256(repr(facts).encode()).hexdigest()[:24]


def _path(key: str) -> Path:
    return cache_folder() / "libero" / f"{key}.safetensors"


def _read_cache(key: str) -> Arrays | None:
    with contextlib.suppress(OSError, SafetensorError):  # missing or damaged
        return load_file(_path(key))
    return None


def _write_cache(key: str, arrays: Arrays) -> Arrays:
    path = _path(key)
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, save(arrays))
    return arrays


def _extract(model: mujoco.MjModel, part: Part) -> Arrays:
    """Return the content to cache of a compiled mesh or texture; none of a texture with another shape or channels."""
    if isinstance(part, mujoco.MjsTexture):
        texture = model.tex(part.name)
        if texture.nchannel[0] != 3 or texture.height[0] != texture.width[0]:
            return {}
        return {"pixels": resized(pixels_of(model, texture.id))}
    mesh = model.mesh(part.name).id
    shown = np.flatnonzero((model.geom_dataid == mesh) & (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value))
    frame = np.concatenate([model.mesh_pos[mesh], model.mesh_quat[mesh], model.geom_size[shown[0]]])
    material = model.geom_matid[shown[0]]
    textured = material >= 0 and model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB.value] >= 0
    shape = triangles_of(model, int(shown[0]))
    position, normal, uv, triangles = in_pieces(welded(_thinned(shape) if textured else shape), MAX_PIECE_TRIANGLES)
    return {"frame": frame, "position": position, "normal": normal, "uv": uv, "triangles": triangles}


def _thinned(shape: Triangles) -> Triangles:
    """Return a simplified shape with preserved texture seams."""
    points, normals, uv, triangles = shape
    if len(triangles) <= THIN_ABOVE or not uv.any() or np.ptp(points, axis=0).max() > MAX_THINNED_SIZE:
        return shape
    import fast_simplification  # needed for the first image on a machine only

    spots, _, spot_uv, same = welded((points, np.zeros_like(points), uv, np.arange(len(points))))
    smooth = np.zeros_like(spots)
    np.add.at(smooth, same, normals)
    faces = same[triangles]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    with _SIMPLIFYING:
        _, _, collapses = fast_simplification.simplify(
            spots, faces, target_count=THIN_TO, agg=5, return_collapses=True, preserve_border=True
        )
        corners, thin, moved = fast_simplification.replay_simplification(spots, faces, collapses)
    if len(thin) > 2 * THIN_TO:  # the texture has so many borders that it would be distorted between them
        return shape
    # Collapsed vertices take texture coordinates and normal of the nearest original vertex.
    distance = np.linalg.norm(spots - corners[moved], axis=1)
    order = np.lexsort((-distance, moved))  # the nearest vertex of each is written last
    nearest = np.zeros(len(corners), np.int64)
    nearest[moved[order]] = order
    flat = np.cross(corners[thin[:, 1]] - corners[thin[:, 0]], corners[thin[:, 2]] - corners[thin[:, 0]])
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
    mean = smooth[nearest] / np.maximum(np.linalg.norm(smooth[nearest], axis=1, keepdims=True), 1e-20)
    edged = np.einsum("fcx,fx->fc", mean[thin], flat) < MIN_NORMAL_COSINE
    normal = np.where(edged[..., None], flat[:, None], mean[thin]).reshape(-1, 3)
    return corners[thin.ravel()], normal, spot_uv[nearest][thin.ravel()], np.arange(thin.size).reshape(-1, 3)


# --- placeholders ---


def _use_placeholder(part: Part) -> None:
    """Replace a mesh by a box, and a texture by a pixel."""
    part.file = ""
    if isinstance(part, mujoco.MjsTexture):
        part.nchannel, part.height, part.width, part.data = 3, 1, 1, bytes(3)
        return
    faces = [corner for a, b, c, d in PLACEHOLDER_FACES for corner in (a, b, c, a, c, d)]
    part.scale, part.refpos, part.refquat = [1.0] * 3, [0.0] * 3, [1.0, 0.0, 0.0, 0.0]
    part.uservert, part.userface = (0.01 * PLACEHOLDER_POINTS).ravel().tolist(), faces


def _set_frames(model: mujoco.MjModel, meshes: Mapping[str, Arrays]) -> None:
    """Give geoms of placeholders the frames and sizes of the cached meshes, which define texture coordinates."""
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH.value):
        mesh = int(model.geom_dataid[geom])
        cached = meshes.get(model.mesh(mesh).name)
        if cached is None:
            continue
        position, quaternion, size = np.split(cached["frame"], (3, 7))
        model.mesh_pos[mesh], model.mesh_quat[mesh] = 0, (1, 0, 0, 0)  # a cached mesh is in its geom's frame
        offset, turn = np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(offset, position, model.geom_quat[geom])
        mujoco.mju_mulQuat(turn, model.geom_quat[geom], quaternion)
        model.geom_pos[geom] += offset
        model.geom_quat[geom] = turn
        model.geom_size[geom] = size
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE.value
