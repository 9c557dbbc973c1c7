"""Recovery data: the arm is moved off its way at random, and the expert, who is closed-loop, finds back.

The labels of a frame are the expert's actions; the executed ones are kept for replay. A third of the episodes stays as
the expert made it.
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
PUSH = np.array([0.6, 0.6, 0.6, 0.1, 0.1, 0.3])
"""Standard deviations of a push, per step: the hand is moved, and turned, mostly as about the vertical."""
PUSH_STEPS = (3, 8)
"""A push lasts at least the first, and less than the second, number of steps."""
MISS_CHANCE = 0.2
"""Probability that the hand is pushed away when its fingers begin to close: they meet, and the expert goes back. A
policy without such frames brings nothing to where the thing should go."""
MISS, MISS_SPREAD = np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0]), np.array([0.25, 0.25, 0.25, 0.0, 0.0, 0.0])
"""Such a push, upwards, and its standard deviations."""
MISS_STEPS = (6, 10)
"""It lasts at least the first, and less than the second, number of steps: about as long as fingers take to close."""
TWIST_CHANCE = 0.15
"""Probability that it is turned away first, with open fingers: they then stop at another width than along a side. A
policy without such frames waits for them to go on."""
TWIST = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.25])
"""Standard deviations of such a push, per step."""
TWIST_STEPS = (3, 6)
"""It lasts at least the first, and less than the second, number of steps."""
DROP_CHANCE = 0.05
"""Probability that what fingers have closed on is let go of on its way."""
DROP_AFTER, DROP_STEPS = (15, 50), 8
"""That begins at least the first, and less than the second, number of steps after they began to close, and lasts."""
LATE_CHANCE, LATE_STEPS = 0.2, (3, 16)
"""Probability that fingers stay shut when they should open: for at least the first, and less than the second, number
of steps. A policy without such frames waits for ever where it should have let go."""
COMING_TO_REST = 0.4
"""Largest component of a displacement, at home's detent, by which an expert means to stay there (2 cm)."""

Array = NDArray[np.float64]


class Perturbation:
    """Disturbances of the arm in one episode; a function of the generator's numbers alone."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._clean = rng.random() < CLEAN
        self._left = 0
        self._push: Array = np.zeros(6)
        self._closed = 0  # steps since the command to close the fingers
        self._open = range(0)  # the steps, counted so, in which they are open all the same
        self._late = 0  # steps for which they stay shut although they should open

    def executed(self, action: NDArray[np.float32], at_detent: bool = False) -> NDArray[np.float32]:
        """Return the action (7,) to execute in place of the expert's. Call once per step.

        Args:
            at_detent: the hand is where home catches what rests; who means to stay is let be, or it never would.
        """
        if self._clean or (at_detent and np.abs(action[:6]).max() <= COMING_TO_REST):
            return action
        opens = self._closed > 0 and action[6] < 0
        self._closed = self._closed + 1 if action[6] > 0 else 0
        if opens:
            self._late = int(self._rng.integers(*LATE_STEPS)) if self._rng.random() < LATE_CHANCE else 0
        if self._closed == 1:
            self._grasp()
        elif not self._left and self._rng.random() < PUSH_CHANCE:
            self._begin(PUSH * self._rng.normal(size=6), PUSH_STEPS)
        found = action.astype(np.float64)
        found[:6] += NOISE * self._rng.normal(size=6)
        if self._left:
            found[:6] += self._push
            self._left -= 1
        if self._closed in self._open:
            found[6] = -1.0
        elif self._late and action[6] < 0:
            found[6] = 1.0
            self._late -= 1
        return found.astype(np.float32)

    def _grasp(self) -> None:
        """Decide what goes wrong with a grasp."""
        self._open = range(0)
        draw = self._rng.random()
        if draw < MISS_CHANCE:
            self._begin(MISS + MISS_SPREAD * self._rng.normal(size=6), MISS_STEPS)
        elif draw < MISS_CHANCE + TWIST_CHANCE:
            self._begin(TWIST * self._rng.normal(size=6), TWIST_STEPS)
            self._open = range(1, self._left + 1)
        elif draw < MISS_CHANCE + TWIST_CHANCE + DROP_CHANCE:
            first = int(self._rng.integers(*DROP_AFTER))
            self._open = range(first, first + DROP_STEPS)

    def _begin(self, push: Array, steps: tuple[int, int]) -> None:
        self._push, self._left = push, int(self._rng.integers(*steps))
