"""Compute camera matrices and lights of a frame: the whole image, a mirrored scene, and part of an image."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.drawlist import Floats
from mujoco_raster.errors import RasterError

# --- cameras ---


def clipping(model: mujoco.MjModel) -> tuple[float, float]:
    """Return the distances of the near and the far clipping plane, m."""
    near, far = (float(p * model.stat.extent) for p in (model.vis.map.znear, model.vis.map.zfar))
    return near, far


class Camera(NamedTuple):
    """Pose and field of view of a camera in one state.

    ``position``: (3,), m; ``frame``: rotation (3, 3), whose columns are the image's right, its top, and the
    direction towards the viewer; ``scale``: 1 / tan of half the horizontal and half the vertical field of view;
    ``shift``: offset of the image's centre from the optical axis, in half widths and half heights; ``still``: whether
    the camera is fixed to the world.
    """

    position: NDArray[np.floating]
    frame: NDArray[np.floating]
    scale: tuple[float, float]
    shift: tuple[float, float]
    still: bool


def model_camera(model: mujoco.MjModel, data: mujoco.MjData, camera: int, height: int, width: int) -> Camera:
    """Return a camera of a model, from its vertical field of view.

    Args:
        model, data: state to draw.
        camera: id of the camera.
        height, width: size of a frame, pixels.
    """
    slope = 1.0 / math.tan(math.radians(float(model.cam_fovy[camera])) / 2)
    still = bool(model.body_weldid[model.cam_bodyid[camera]] == 0)
    frame = data.cam_xmat[camera].reshape(3, 3)
    return Camera(data.cam_xpos[camera], frame, (slope * height / width, slope), (0.0, 0.0), still)


def scene_camera(scene: mujoco.MjvScene, height: int, width: int, still: bool) -> Camera:
    """Return the camera of an abstract scene after `mujoco.mjv_updateCamera`, at single precision as in OpenGL.

    Raises:
        RasterError: the camera is orthographic.
    """
    camera = mujoco.mjv_averageCamera(*scene.camera[:2])
    if camera.orthographic:
        raise RasterError("the camera is orthographic, which is not drawn; use a perspective camera")
    backward, up = -np.array(camera.forward, np.float64), np.array(camera.up, np.float64)
    frame = np.column_stack([np.cross(up, backward), up, backward])
    near, half_height = float(camera.frustum_near), (camera.frustum_top - camera.frustum_bottom) / 2
    half_width = float(camera.frustum_width) or half_height * width / height
    scale = near / half_width, near / half_height
    shift = camera.frustum_center / half_width, (camera.frustum_top + camera.frustum_bottom) / 2 / half_height
    return Camera(np.array(camera.pos, np.float64), frame, scale, shift, still)


def camera_matrix(model: mujoco.MjModel, camera: Camera) -> Floats:
    """Return the matrix (4, 4) from the world to a camera's clip space, upside down.

    The first row of the image is therefore the top one; the orientation of faces is reversed.
    """
    near, far = clipping(model)
    frame = camera.frame
    view = np.concatenate([frame.T, -(frame.T @ camera.position)[:, None]], axis=1)
    matrix = np.empty((4, 4), dtype=np.float32)
    matrix[0] = camera.scale[0] * view[0] + camera.shift[0] * view[2]
    matrix[1] = -camera.scale[1] * view[1] - camera.shift[1] * view[2]
    matrix[2] = (far + near) / (near - far) * view[2]
    matrix[2, 3] += 2 * far * near / (near - far)
    matrix[3] = -view[2]
    return matrix


def mirrored(matrix: Floats, point: Floats, normal: Floats) -> Floats:
    """Return a camera's matrix (4, 4) for the mirrored scene with a horizontally flipped image.

    The two reflections preserve the clockwise orientation of faces.
    """
    mirror = np.eye(4)
    mirror[:3, :3] -= 2.0 * np.outer(normal, normal)
    mirror[:3, 3] = 2.0 * (normal @ point) * normal
    turned: Floats = (np.diag([-1.0, 1.0, 1.0, 1.0]) @ matrix @ mirror).astype(np.float32)
    return turned


def cropped(matrix: Floats, whole: tuple[int, ...], corner: tuple[int, int], shape: tuple[int, ...]) -> Floats:
    """Return a camera's matrix (4, 4) for part of its image.

    Args:
        matrix: matrix of the whole image.
        whole: height and width of the whole image.
        corner: first column and row of the part.
        shape: height and width of the part.
    """
    crop = np.eye(4)
    for axis in range(2):
        pixels, part = whole[1 - axis], shape[1 - axis]
        crop[axis, axis] = pixels / part
        crop[axis, 3] = (pixels - 2 * corner[axis]) / part - 1.0
    part_of: Floats = (crop @ matrix).astype(np.float32)
    return part_of


# --- lights ---

_PARALLEL = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
_SPOT = mujoco.mjtLightType.mjLIGHT_SPOT.value


def active_lights(model: mujoco.MjModel) -> list[int]:
    """Return the ids of active directional lights and spots, as in MuJoCo's renderer."""
    return [k for k in range(model.nlight) if model.light_active[k] and model.light_type[k] in (_PARALLEL, _SPOT)]


class Lights(NamedTuple):
    """Lights of a frame, the headlight first.

    ``to``: (L, 3), direction to a directional light, position of a spot; ``placed``: (L,), whether it is a spot;
    ``axis``: (L, 3), direction of a spot; ``cone``: (L, 2), cosine of the cutoff, and exponent; ``attenuation``,
    ``ambient``, ``diffuse``, ``specular``: (L, 3).
    """

    to: Floats
    placed: NDArray[np.bool_]
    axis: Floats
    cone: Floats
    attenuation: Floats
    ambient: Floats
    diffuse: Floats
    specular: Floats


class SceneLights:
    """Lights of a compiled scene; colours are read once, directions per frame. Shadows are not drawn."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._ids = ids = active_lights(model)
        head, count = model.vis.headlight, 1 + len(ids)
        on = float(head.active != 0)  # 2 is the default of MuJoCo 4
        self.lights = Lights(
            to=np.zeros((count, 3), np.float32),
            placed=np.concatenate([[False], model.light_type[ids] != _PARALLEL]),
            axis=np.zeros((count, 3), np.float32),
            cone=np.tile(np.array([-1.0, 0.0], np.float32), (count, 1)),
            attenuation=np.vstack([[1.0, 0.0, 0.0], model.light_attenuation[ids]]).astype(np.float32),
            ambient=np.vstack([on * head.ambient, model.light_ambient[ids]]).astype(np.float32),
            diffuse=np.vstack([on * head.diffuse, model.light_diffuse[ids]]).astype(np.float32),
            specular=np.vstack([on * head.specular, model.light_specular[ids]]).astype(np.float32),
        )
        cutoff = np.asarray(model.light_cutoff[ids])
        self.lights.cone[1:, 0] = np.where(cutoff >= 180.0, -1.0, np.cos(np.radians(cutoff)))
        self.lights.cone[1:, 1] = model.light_exponent[ids]

    def update(self, data: mujoco.MjData, camera: Camera) -> Lights:
        """Return the lights of a state, with the headlight at a camera; overwritten by the next call."""
        lights = self.lights
        axis = data.light_xdir[self._ids]
        lights.to[0] = camera.frame[:, 2]
        lights.axis[1:] = axis
        lights.to[1:] = np.where(lights.placed[1:, None], data.light_xpos[self._ids], -axis)
        return lights
