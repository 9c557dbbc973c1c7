"""Is the hand home, is a thing in its place? Predicates that compare the present with how the episode began.

Within any tolerance a pose can carry a number. So nothing is tolerated: in strict scenes home has a detent, and an arm
counts as home only as the detent makes it stand (`Start.in_detent`).
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim import robot
from lerobot_memobench.tasks.formula import Atom

DETENT_DISTANCE = 0.02
"""How far from where it was the grip site is caught, m: twice what learned policies miss it by."""
DETENT_ANGLE = 0.1
"""How far the hand may be turned from how it was, rad."""
DETENT_OPENING = 0.01
"""How far each finger may be from where it was, m: a hand that holds something is not caught."""
DETENT_SPEED = (0.03, 0.15)
"""How fast the hand may be, m/s and rad/s: learned policies hover at 2 cm/s. An action of 0.2 leaves in a step."""
SAME_ARM = 1e-4
"""Difference of the arm's joints and fingers (rad, m) and their velocities up to which it stands as it did: states that
were read from a file are rounded."""
PLACE_DISTANCE = 0.01
"""How far a thing may be from where it stood, m: two pixels, up to which pictures count as the same."""


class Start:
    """What is compared with: the hand's pose after the scene settled, things as the execution found them.

    Args:
        model, data: a simulation's; poses must belong to the present state.
        things: names of the instances whose places are remembered.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, things: Sequence[str]) -> None:
        self._data = data
        self._grip = model.site(robot.GRIP_SITE).id
        self._model = model
        self._fingers = [int(model.joint(name).qposadr[0]) for name in robot.FINGER_JOINTS]
        self._joints = slice(0, max(self._fingers) + 1)  # the arm comes first in the model, its fingers last of it
        self._bodies = {name: int(model.body(name).id) for name in things}
        self.mark_hand()

    def mark_hand(self) -> None:
        """Take the arm's present state for its home."""
        self._arm, self._stood = self._arm_now(), False
        self._position, self._rotation, self._opening = self._hand()

    @property
    def home(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,) and rotation (3, 3) of the grip site at home."""
        return self._position, self._rotation

    def mark_step(self, goes_on: bool = True) -> None:
        """Note where a step begins: who leaves home in it was there. A state that does not go on was not left."""
        self._stood = goes_on and self._stands()

    def mark_things(self) -> None:
        """Take every thing's present place for its own."""
        self._places = {name: self._data.xpos[body].copy() for name, body in self._bodies.items()}

    def holds(self, atom: Atom) -> bool:
        """Return whether ``handhome`` or ``inplace`` is true now."""
        if atom.predicate == "handhome":
            return self._stood or self._stands()
        (name,) = atom.args
        moved = self._data.xpos[self._bodies[name]] - self._places[name]
        return float(np.linalg.norm(moved)) <= PLACE_DISTANCE

    def _stands(self) -> bool:
        """Whether the arm stands as when the scene had settled, joint for joint."""
        return bool(np.abs(self._arm_now() - self._arm).max() <= SAME_ARM)

    def in_detent(self) -> bool:
        """Return whether the open hand has come to rest near its home, so that the detent catches it."""
        return self.at_detent() and bool(np.all(self._speed() <= DETENT_SPEED))

    def at_detent(self) -> bool:
        """Return whether the open hand is so near its home that the detent would catch it at rest."""
        position, rotation, opening = self._hand()
        cosine = (np.trace(self._rotation.T @ rotation) - 1.0) / 2.0
        return bool(
            np.linalg.norm(position - self._position) <= DETENT_DISTANCE
            and np.arccos(np.clip(cosine, -1.0, 1.0)) <= DETENT_ANGLE
            and np.all(np.abs(opening - self._opening) <= DETENT_OPENING)
        )

    def _speed(self) -> NDArray[np.float64]:
        """Speed of the grip site, m/s and rad/s, (2,)."""
        velocity = np.empty(6)  # the turning first
        site = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(self._model, self._data, site, self._grip, velocity, 0)
        return np.array([np.linalg.norm(velocity[3:]), np.linalg.norm(velocity[:3])])

    def _arm_now(self) -> NDArray[np.float64]:
        """Positions and velocities of arm and fingers."""
        return np.append(self._data.qpos[self._joints], self._data.qvel[self._joints])

    def _hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,), rotation (3, 3) of the grip site and finger positions (2,)."""
        data = self._data
        rotation = data.site_xmat[self._grip].reshape(3, 3).copy()
        return data.site_xpos[self._grip].copy(), rotation, data.qpos[self._fingers].copy()
