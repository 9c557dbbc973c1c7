"""Is the hand home, is a thing in its place? Predicates that compare the present with how the episode began."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim import robot
from lerobot_memobench.tasks.formula import Atom

HOME_DISTANCE = 0.03
"""How far the grip site may be from where it was, m."""
HOME_ANGLE = 0.2
"""How far the hand may be turned from how it was, rad."""
HOME_OPENING = 0.01
"""How far each finger may be from where it was, m: a hand that holds something, or keeps a bit, is not home."""
PLACE_DISTANCE = 0.03
"""How far a thing may be from where it stood, m."""


class Start:
    """What is compared with: the hand's pose after the scene settled, things as the execution found them.

    Args:
        model, data: a simulation's; poses must belong to the present state.
        things: names of the instances whose places are remembered.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, things: Sequence[str]) -> None:
        self._data = data
        self._grip = model.site(robot.GRIP_SITE).id
        self._fingers = [int(model.joint(name).qposadr[0]) for name in robot.FINGER_JOINTS]
        self._bodies = {name: int(model.body(name).id) for name in things}

    def mark_hand(self) -> None:
        """Take the hand's present pose for its home."""
        self._position, self._rotation, self._opening = self._hand()

    @property
    def home(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,) and rotation (3, 3) of the grip site at home."""
        return self._position, self._rotation

    def mark_things(self) -> None:
        """Take every thing's present place for its own."""
        self._places = {name: self._data.xpos[body].copy() for name, body in self._bodies.items()}

    def holds(self, atom: Atom) -> bool:
        """Return whether ``handhome`` or ``inplace`` is true now."""
        if atom.predicate == "handhome":
            return self._hand_home()
        (name,) = atom.args
        moved = self._data.xpos[self._bodies[name]] - self._places[name]
        return float(np.linalg.norm(moved)) <= PLACE_DISTANCE

    def _hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,), rotation (3, 3) of the grip site and finger positions (2,)."""
        data = self._data
        rotation = data.site_xmat[self._grip].reshape(3, 3).copy()
        return data.site_xpos[self._grip].copy(), rotation, data.qpos[self._fingers].copy()

    def _hand_home(self) -> bool:
        position, rotation, opening = self._hand()
        cosine = (np.trace(self._rotation.T @ rotation) - 1.0) / 2.0
        return bool(
            np.linalg.norm(position - self._position) <= HOME_DISTANCE
            and np.arccos(np.clip(cosine, -1.0, 1.0)) <= HOME_ANGLE
            and np.all(np.abs(opening - self._opening) <= HOME_OPENING)
        )
