"""Read the lights of a scene, and compute the matrix of the shadow-casting light."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.raster.drawlist import Floats

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
