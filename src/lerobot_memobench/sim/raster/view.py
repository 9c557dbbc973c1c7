"""Compute camera matrices: the whole image, a mirrored scene, part of an image."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from lerobot_memobench.sim.raster.drawlist import Floats


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
