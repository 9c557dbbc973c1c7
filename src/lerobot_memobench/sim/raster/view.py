"""The place of a camera: its matrix to clip space, and its clipping planes."""

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

    So the first row that is read back is the top one; faces turn around with it.

    Args:
        model, data: the state to show.
        camera: its id.
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
