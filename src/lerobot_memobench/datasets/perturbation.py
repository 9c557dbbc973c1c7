"""Recovery data: the arm is moved off its way at random, and the expert, who is closed-loop, finds back.

What a policy learns at each frame is what the expert does there; what was executed instead is kept for replay. A third
of the episodes stays as the expert made it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CLEAN = 1 / 3
"""Share of the episodes in which nothing is moved."""
NOISE = 0.05
"""Standard deviation of what is added to each of an action's six displacements (1 is 5 cm or 0.5 rad)."""
PUSH_CHANCE = 0.02
"""Probability per step that a push begins."""
PUSH = 0.6
"""Standard deviation of a push, per axis and step, of the hand's displacement."""
PUSH_STEPS = (3, 8)
"""A push lasts at least the first, and less than the second, number of steps."""


class Perturbation:
    """What moves the arm off its way in one episode; a function of the generator's numbers alone."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._clean = rng.random() < CLEAN
        self._left = 0
        self._push: NDArray[np.float64] = np.zeros(3)

    def moved(self, action: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what is executed in place of an action (7,); the gripper does as it is told. Ask once per step."""
        if self._clean:
            return action
        found = action.astype(np.float64)
        found[:6] += NOISE * self._rng.normal(size=6)
        if not self._left and self._rng.random() < PUSH_CHANCE:
            self._left = int(self._rng.integers(*PUSH_STEPS))
            self._push = PUSH * self._rng.normal(size=3)
        if self._left:
            found[:3] += self._push
            self._left -= 1
        return found.astype(np.float32)
