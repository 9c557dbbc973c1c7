"""What a camera and a light see, as matrices to clip space, and all that the shaders are told of a frame."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.drawing.drawlist import Floats
from lerobot_memobench.sim.drawing.shaders import frame_block


class View:
    """What the shaders are told of a frame, in their layout (`shaders.frame_block`).

    Args:
        model: where lights and clipping planes are read from.
        lights: ids of the directional lights that shine.
        caster: which of them casts shadows, None for none.
        height, width: size of a frame, pixels.
    """

    def __init__(self, model: mujoco.MjModel, lights: list[int], caster: int | None, height: int, width: int) -> None:
        self._lights, self._caster, self._height, self._width = lights, caster, height, width
        head = model.vis.headlight  # goes before the other lights
        self.block: NDArray[Any] = np.zeros((), dtype=frame_block(1 + len(lights)))
        self.block["light"] = np.eye(4)
        self.block["ambient"][:3] = (head.ambient + model.light_ambient[lights].sum(axis=0)).astype(np.float32)
        self.block["light_diffuse"][:, :3] = np.vstack([head.diffuse, model.light_diffuse[lights]])
        self.block["light_specular"][:, :3] = np.vstack([head.specular, model.light_specular[lights]])
        self._shining: bytes | None = None

    def look(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> NDArray[Any]:
        """Return the block for a camera's view of a state; it is overwritten by the next call."""
        block = self.block
        # The shaders keep matrices by columns.
        block["projection"] = camera_matrix(model, data, camera, self._height, self._width).T
        block["eye"][:3] = data.cam_xpos[camera]
        directions = data.light_xdir[self._lights]
        block["light_to"][0, :3] = data.cam_xmat[camera].reshape(3, 3)[:, 2]  # a headlight shines from the camera
        block["light_to"][1:, :3] = -directions
        shining = directions.tobytes()
        if self._caster is not None and shining != self._shining:  # lamps hang still
            self._shining = shining
            block["light"] = light_matrix(model, data, self._caster).T
        return block


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
