"""From where the hand should be to what a policy would have to output: smooth actions inside [−1, 1]."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.simulation import Simulation

Array = NDArray[np.float64]
Motion = Iterator[NDArray[np.float32]]
"""Actions, one per control step; each is computed from the state at the time it is asked for."""
Target = Callable[[], Array]
"""A position (3,) or rotation (3, 3) that may move while it is being reached."""

OPEN, CLOSED = -1.0, 1.0
DOWN = np.array([0.0, 0.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])

POSITION_SCALE, ROTATION_SCALE = 0.05, 0.5
"""Metres and radians per unit of action (OSC_POSE)."""


def frame(approach: Array, closing: Array) -> Array:
    """Return the hand's rotation (3, 3): z along ``approach`` (out of the palm), x along which the fingers close."""
    z = np.asarray(approach, dtype=np.float64) / np.linalg.norm(approach)
    x = np.asarray(closing, dtype=np.float64)
    x = x - z * (x @ z)
    x = x / np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


_EASY_CLOSING = np.array([-0.5, np.sqrt(0.75), 0.0])


def downward(yaw: float) -> Array:
    """Return the rotation of a hand that points down, its fingers closing along the horizontal angle ``yaw``, rad.

    A parallel gripper does not care which finger is which: of the two half turns the one that leaves the last joint
    of the arm farther from its stops is taken.
    """
    closing = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return frame(DOWN, closing if closing @ _EASY_CLOSING >= 0 else -closing)


class Hand:
    """The arm as an expert drives it: targets in, actions out.

    Args:
        sim: the running scene.
        rng: source of this episode's style.
    """

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self.sim = sim
        self.rng = rng
        self.speed = float(rng.uniform(0.62, 0.82))
        """Largest linear action of this episode; 1 is about 0.25 m/s."""
        self.slew = float(rng.uniform(0.16, 0.22))
        """Largest change of an action's component per step."""
        self.rotation_speed = 0.35
        self._last = np.zeros(6)

    @property
    def position(self) -> Array:
        """Where the grip site is, (3,), m."""
        return self.sim.eef_pose()[0]

    @property
    def rotation(self) -> Array:
        """How the hand is turned, (3, 3)."""
        return self.sim.eef_pose()[1]

    def toward(
        self, position: Array, rotation: Array, gripper: float, speed: float = 1.0
    ) -> NDArray[np.float32]:
        """Return the action (7,) that brings the hand nearer to a pose."""
        here, turned = self.sim.eef_pose()
        linear = (position - here) / POSITION_SCALE
        limit = self.speed * speed
        linear *= min(1.0, limit / max(float(np.linalg.norm(linear)), 1e-9))
        angular = Rotation.from_matrix(rotation @ turned.T).as_rotvec() / ROTATION_SCALE
        angular *= min(1.0, self.rotation_speed / max(float(np.linalg.norm(angular)), 1e-9))
        wanted = np.concatenate([linear, angular])
        self._last = self._last + np.clip(wanted - self._last, -self.slew, self.slew)
        return np.append(self._last, gripper).astype(np.float32)

    def error(self, position: Array, rotation: Array) -> tuple[float, float]:
        """Return the distance to a pose, m and rad."""
        here, turned = self.sim.eef_pose()
        angle = float(np.linalg.norm(Rotation.from_matrix(rotation @ turned.T).as_rotvec()))
        return float(np.linalg.norm(position - here)), angle

    def move(
        self,
        position: Array | Target,
        rotation: Array | Target,
        gripper: float,
        *,
        tolerance: float = 0.006,
        turn_tolerance: float = 0.05,
        speed: float = 1.0,
        timeout: int = 160,
        give_up: Callable[[], bool] | None = None,
    ) -> Motion:
        """Go to a pose, following it where it moves; stop after ``timeout`` steps or when ``give_up`` says so."""
        for _ in range(timeout):
            if give_up is not None and give_up():
                return
            goal = position() if callable(position) else position
            turn = rotation() if callable(rotation) else rotation
            distance, angle = self.error(goal, turn)
            if distance < tolerance and angle < turn_tolerance:
                return
            yield self.toward(goal, turn, gripper, speed)

    def lower(self, position: Target, rotation: Array, gripper: float, *, tolerance: float) -> Motion:
        """Go down to a pose, slowly; stop where something carries the load: when the hand gets no lower."""
        heights: list[float] = []
        for _ in range(60):
            goal = position()
            if self.error(goal, rotation)[0] < tolerance:
                return
            heights.append(float(self.position[2]))
            if len(heights) > 12 and heights[-9] - heights[-1] < 0.002:
                return
            yield self.toward(goal, rotation, gripper, 0.45)

    def wait(self, steps: int, gripper: float) -> Motion:
        """Hold still for some steps, for the fingers to move or a thing to settle."""
        position, rotation = self.sim.eef_pose()
        for _ in range(steps):
            yield self.toward(position, rotation, gripper)

    def close(
        self, position: Target | None = None, rotation: Array | None = None, least: int = 8, most: int = 24
    ) -> Motion:
        """Close the fingers, at rest or following a target, until they stop on something or on each other."""
        here, turned = self.sim.eef_pose()
        before = self.sim.gripper_opening()
        for step in range(most):
            goal = here if position is None else position()
            yield self.toward(goal, turned if rotation is None else rotation, CLOSED)
            now = self.sim.gripper_opening()
            if step >= least and before - now < 2e-4:
                return
            before = now
