"""Compute camera matrices and lights of a frame: the whole image, a mirrored scene, part of an image, and shadows."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.raster.drawlist import Floats

# --- cameras ---


def clipping(model: mujoco.MjModel) -> tuple[float, float]:
    """Return the distances of the near and the far clipping plane, m."""
    near, far = (float(p * model.stat.extent) for p in (model.vis.map.znear, model.vis.map.zfar))
    return near, far


def camera_matrix(model: mujoco.MjModel, data: mujoco.MjData, camera: int, height: int, width: int) -> Floats:
    """Return the matrix (4, 4) from the world to a camera's clip space, upside down.

    The first row of the image is therefore the top one; the orientation of faces is reversed.

    Args:
        model, data: state to draw.
        camera: id of the camera.
        height, width: size of a frame, pixels.
    """
    eye, frame = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    near, far = clipping(model)
    slope = 1.0 / math.tan(math.radians(float(model.cam_fovy[camera])) / 2)
    view = np.concatenate([frame.T, -(frame.T @ eye)[:, None]], axis=1)
    matrix = np.empty((4, 4), dtype=np.float32)
    matrix[0] = slope * height / width * view[0]
    matrix[1] = -slope * view[1]
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


def shadow_caster(model: mujoco.MjModel) -> int | None:
    """Return the id of the first directional light that casts shadows, None without one."""
    casting = [k for k in active_lights(model) if model.light_castshadow[k] and model.light_type[k] == _PARALLEL]
    return casting[0] if casting else None


class Lights(NamedTuple):
    """Lights of a frame, the headlight first.

    ``to``: (L, 3), direction to a directional light, position of a spot; ``placed``: (L,), whether it is a spot;
    ``axis``: (L, 3), direction of a spot; ``cone``: (L, 2), cosine of the cutoff, and exponent; ``attenuation``,
    ``ambient``, ``diffuse``, ``specular``: (L, 3). ``caster``: index of the shadow-casting light, −1 for none.
    ``clamped``: whether light is clipped to 1 before it is multiplied by the texture.
    """

    to: Floats
    placed: NDArray[np.bool_]
    axis: Floats
    cone: Floats
    attenuation: Floats
    ambient: Floats
    diffuse: Floats
    specular: Floats
    caster: int
    clamped: bool


class SceneLights:
    """Lights of a scene; colours are read once, directions per frame.

    Args:
        model: compiled scene.
        shadows: whether to draw shadows of the first shadow-casting light.
        clamped: see `Lights`.
    """

    def __init__(self, model: mujoco.MjModel, shadows: bool, clamped: bool = False) -> None:
        self._ids = ids = active_lights(model)
        caster = shadow_caster(model) if shadows else None
        self.caster = caster
        head, count = model.vis.headlight, 1 + len(ids)
        on = float(head.active)
        self._light_matrix: tuple[bytes, Floats] = (b"", np.eye(4, dtype=np.float32))
        self.lights = Lights(
            to=np.zeros((count, 3), np.float32),
            placed=np.concatenate([[False], model.light_type[ids] != _PARALLEL]),
            axis=np.zeros((count, 3), np.float32),
            cone=np.tile(np.array([-1.0, 0.0], np.float32), (count, 1)),
            attenuation=np.vstack([[1.0, 0.0, 0.0], model.light_attenuation[ids]]).astype(np.float32),
            ambient=np.vstack([on * head.ambient, model.light_ambient[ids]]).astype(np.float32),
            diffuse=np.vstack([on * head.diffuse, model.light_diffuse[ids]]).astype(np.float32),
            specular=np.vstack([on * head.specular, model.light_specular[ids]]).astype(np.float32),
            caster=-1 if caster is None else 1 + ids.index(caster),
            clamped=clamped,
        )
        cutoff = np.asarray(model.light_cutoff[ids])
        self.lights.cone[1:, 0] = np.where(cutoff >= 180.0, -1.0, np.cos(np.radians(cutoff)))
        self.lights.cone[1:, 1] = model.light_exponent[ids]

    def update(self, data: mujoco.MjData, camera: int) -> Lights:
        """Return the lights of a state, with the headlight at a camera; overwritten by the next call."""
        lights = self.lights
        axis = data.light_xdir[self._ids]
        lights.to[0] = data.cam_xmat[camera].reshape(3, 3)[:, 2]
        lights.axis[1:] = axis
        lights.to[1:] = np.where(lights.placed[1:, None], data.light_xpos[self._ids], -axis)
        return lights

    def light_matrix(self, model: mujoco.MjModel, data: mujoco.MjData) -> Floats:
        """Return the matrix (4, 4) from the world to the caster's clip space; cached while the caster is static."""
        if self.caster is not None:
            direction = data.light_xdir[self.caster].tobytes()
            if direction != self._light_matrix[0]:
                self._light_matrix = direction, light_matrix(model, data, self.caster)
        return self._light_matrix[1]


def light_matrix(model: mujoco.MjModel, data: mujoco.MjData, light: int) -> Floats:
    """Return the matrix (4, 4) from the world to the clip space of a directional light."""
    forward = data.light_xdir[light]
    if not forward.any():  # no kinematics were computed yet
        forward = model.light_dir[light]
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    half = float(model.vis.map.shadowclip * model.stat.extent)
    centre = model.stat.center
    matrix = np.zeros((4, 4), dtype=np.float32)
    for row, axis in enumerate((side, up, forward)):
        reach = half if row < 2 else 2.0 * half
        matrix[row, :3] = axis / reach
        matrix[row, 3] = -axis @ centre / reach
    matrix[3, 3] = 1.0
    return matrix
