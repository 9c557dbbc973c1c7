"""Keep hidden objects outside the scene until their drawers open.

An object that a prompt hides must not be observable, not even by a camera inside the shut drawer or by a drawer that
moves otherwise. So it is absent: parked far above the scene, at a position that is equal in all variants. The
simulation is therefore bit-identical between variants until a drawer that contains an object is ajar.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

PARKING_HEIGHT = 1000.0
"""Height of parked objects, m, plus 1 m times the body's number: outside the cameras' range, without contact."""


@dataclass(frozen=True, eq=False)
class HiddenObject:
    """An absent object.

    Attributes:
        name: object.
        region: region of its drawer.
        offset: (3,) position relative to the region's site, m.
        quaternion: (4,) orientation wxyz.
    """

    name: str
    region: str
    offset: Array
    quaternion: Array


class HiddenObjects:
    """Park hidden objects of a simulation, and put each into its drawer when that is ajar.

    Args:
        model, data: model and data of the simulation.

    Attributes:
        absent: objects that are parked.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self.absent: tuple[HiddenObject, ...] = ()

    def describe(self, name: str, region: str) -> HiddenObject:
        """Return an object that rests in a drawer, with its present pose relative to the drawer."""
        body, site = self._data.body(name), self._data.site(region)
        return HiddenObject(name, region, body.xpos - site.xpos, body.xquat.copy())

    def park(self) -> None:
        """Write the poses of absent objects; the derived quantities of ``data`` are not updated."""
        for hidden in self.absent:
            height = PARKING_HEIGHT + self._model.body(hidden.name).id
            self._write(hidden.name, np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]), np.zeros(3))

    def reveal(self, regions: Sequence[str]) -> list[str]:
        """Put absent objects into the drawers of ``regions``, with the drawers' velocities; return their names."""
        found = [hidden for hidden in self.absent if hidden.region in regions]
        self.absent = tuple(hidden for hidden in self.absent if hidden not in found)
        for hidden in found:
            velocity = np.empty(6)  # angular part first
            site = self._data.site(hidden.region)
            mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_SITE, site.id, velocity, 0)
            self._write(hidden.name, np.concatenate([site.xpos + hidden.offset, hidden.quaternion]), velocity[3:])
        return [hidden.name for hidden in found]

    def _write(self, name: str, pose: Array, velocity: Array) -> None:
        """Set pose (7,) and linear velocity (3,), m/s, of an object."""
        joint = self._model.joint(int(self._model.body(name).jntadr[0]))
        qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._data.qpos[qpos : qpos + 7] = pose
        self._data.qvel[dof : dof + 6] = [*velocity, 0.0, 0.0, 0.0]
