"""What a camera and a light see, as matrices to clip space."""

from __future__ import annotations

import mujoco
import numpy as np

from lerobot_memobench.sim.drawing.drawlist import Floats


def camera_matrix(model: mujoco.MjModel, data: mujoco.MjData, camera: int, height: int, width: int) -> Floats:
    """Return the matrix (4, 4) from the world to a camera's clip space, upside down.

    So the first row that is read back is the top one; faces turn around with it.

    Args:
        model, data: the state to show.
        camera: its id.
        height, width: size of a frame, pixels.
    """
    eye, frame = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    near, far = (float(p * model.stat.extent) for p in (model.vis.map.znear, model.vis.map.zfar))
    slope = 1.0 / np.tan(np.radians(float(model.cam_fovy[camera])) / 2)
    projection = np.zeros((4, 4))
    projection[0, 0] = slope * height / width
    projection[1, 1] = -slope
    projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1.0
    view = np.eye(4)
    view[:3, :3] = frame.T
    view[:3, 3] = -frame.T @ eye
    return (projection @ view).astype(np.float32)


def light_matrix(model: mujoco.MjModel, data: mujoco.MjData, light: int) -> Floats:
    """Return the matrix (4, 4) from the world to the clip space of a directional light."""
    forward = data.light_xdir[light]
    if not forward.any():  # nothing was simulated yet
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
