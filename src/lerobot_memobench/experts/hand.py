"""Convert target poses of the hand into smooth actions within [−1, 1]."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.robot import ARM_JOINTS, POSITION_SCALE, ROTATION_SCALE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import STRICT

Array = NDArray[np.float64]
Steps = Generator[NDArray[np.float32], None, None]
"""A motion: yields actions (7,), each computed from the present state."""
Target = Callable[[], Array]  # returns the present value of a moving target position (3,) or rotation (3, 3)

OPEN, CLOSED = -1.0, 1.0
DOWN = np.array([0.0, 0.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])

PASSING_TOLERANCE = 0.02  # position tolerance from which the hand need not slow down, m
ROTATION_SPEED = 0.35  # largest angular action
ARRIVAL_ACTION = 0.4  # largest linear action at which the hand stops without overshoot
STALL_STEPS = 25  # steps without progress after which the hand counts as blocked
SHOULDER_BODY = "robot0_link2"  # body whose origin is the shoulder's centre of rotation
FLANGE_LENGTH, WRIST_OFFSET = 0.2035, 0.088
"""Distance from the grip site back to the last joint, and from there sideways to the wrist, m."""
MAX_STRETCH = 0.70  # largest distance from shoulder to wrist, m; the arm is straight at 0.719 m
COMFORTABLE_STRETCH = 0.685  # distance from shoulder to wrist up to which reaching has no cost, m
STRAIGHT_ELBOW_ANGLE = -0.42  # elbow angle above which the arm is bent backwards through its straight pose, rad
EMPTY_OPENING = 0.003  # finger opening up to which the hand is empty, m
MAX_OPENING_STEPS = 40  # maximum number of steps for opening the fingers
MAX_LAST_JOINT_ANGLE = 2.75  # largest angle of the last joint, rad; its axis is the direction of the fingers


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors (3,), fifty times as fast as numpy's."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def length(vector: Array) -> float:
    """Return the length of a vector."""
    return math.sqrt(float(vector @ vector))


def unit(vector: Array) -> Array:
    """Return the unit vector; a zero vector is unchanged."""
    return vector / max(length(vector), 1e-9)


def frame(approach: Array, closing: Array) -> Array:
    """Return the hand's rotation (3, 3): z along ``approach`` (out of the palm), x along the closing direction."""
    z = unit(np.asarray(approach, dtype=np.float64))
    x = np.asarray(closing, dtype=np.float64)
    x = unit(x - z * (x @ z))
    return np.array([x, cross(z, x), z]).T


def rotation_vector(matrix: Array) -> Array:
    """Return the rotation vector (3,), rad, of a rotation matrix (3, 3)."""
    # SciPy's validation takes two thirds of the time and does not change rotations.
    return Rotation.from_matrix(matrix, assume_valid=True).as_rotvec()


NEUTRAL_CLOSING = np.array([-0.5, np.sqrt(0.75), 0.0])
"""Closing direction of a downward hand with the last joint at mid-range."""


def downward(yaw: float) -> Array:
    """Return the rotation (3, 3) of a downward hand that closes along the horizontal angle ``yaw``, rad."""
    # A parallel gripper is symmetric: of the two orientations choose the one farther from the last joint's limits.
    closing = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return frame(DOWN, closing if closing @ NEUTRAL_CLOSING >= 0 else -closing)


class Hand:
    """Compute actions that move the arm of a running simulation to targets; speed and smoothness are random."""

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self.sim, self.rng = sim, rng
        self.strict = sim.task.suite == STRICT
        """Whether the task is strict; published tasks keep the motions of their published demonstrations."""
        self.speed = float(rng.uniform(0.62, 0.82))  # largest linear action of this episode; 1 is about 0.25 m/s
        self.slew = float(rng.uniform(0.16, 0.22))  # largest change of an action's component per step
        self._last: Array = np.zeros(6)

    @property
    def position(self) -> Array:
        """Position of the grip site (3,), m."""
        return self.sim.eef_pose()[0]

    @property
    def rotation(self) -> Array:
        """Rotation of the hand (3, 3)."""
        return self.sim.eef_pose()[1]

    @property
    def empty(self) -> bool:
        """Whether the fingers have closed on each other."""
        return self.sim.gripper_opening() <= EMPTY_OPENING

    def toward(self, position: Array, rotation: Array, gripper: float, speed: float = 1.0) -> NDArray[np.float32]:
        """Return the action (7,) towards a pose."""
        here, turned = self.sim.eef_pose()
        if self.sim.data.joint(ARM_JOINTS[3]).qpos[0] > STRAIGHT_ELBOW_ANGLE:
            # The elbow passed its straight pose; it bends back correctly only from a stretched arm.
            position = here + 0.04 * self.radial(here)
        linear = (position - here) / POSITION_SCALE
        limit = self.speed * speed
        linear *= min(1.0, limit / max(length(linear), 1e-9))
        angular = self._turn(rotation, turned) / ROTATION_SCALE
        angular *= min(1.0, ROTATION_SPEED / max(length(angular), 1e-9))
        wanted = np.concatenate([linear, angular])
        # Rounded, because numpy's products differ in the last bit between processors. The sum turns −0 into 0.
        self._last = np.round(self._last + np.clip(wanted - self._last, -self.slew, self.slew), 6) + 0.0
        return np.append(self._last, gripper).astype(np.float32)

    def rest(self) -> NDArray[np.float32]:
        """Return the action (7,) that decelerates the present motion, with open fingers."""
        self._last = self._last - np.clip(self._last, -self.slew, self.slew)
        return np.append(self._last, OPEN).astype(np.float32)

    def radial(self, place: Array) -> Array:
        """Return the horizontal direction (3,) from the arm's base to a position."""
        return unit((place - self.sim.data.body(SHOULDER_BODY).xpos) * np.array([1.0, 1.0, 0.0]))

    def stretch(self, position: Array, rotation: Array) -> float:
        """Return the distance from shoulder to wrist for a pose of the hand, m."""
        inward = -self.radial(position)
        inward = unit(inward - rotation[:, 2] * (inward @ rotation[:, 2]))
        wrist = position - FLANGE_LENGTH * rotation[:, 2] + WRIST_OFFSET * inward
        return length(wrist - self.sim.data.body(SHOULDER_BODY).xpos)

    def _turn(self, rotation: Array, turned: Array) -> Array:
        """Return the rotation vector (3,) to an orientation, rad: the short way if the last joint allows it."""
        turn = rotation_vector(rotation @ turned.T)
        angle = length(turn)
        last = float(self.sim.data.joint(ARM_JOINTS[-1]).qpos[0]) + turn @ turned[:, 2]
        return turn * (1.0 - 2 * np.pi / angle) if angle > 1.5 and abs(last) > MAX_LAST_JOINT_ANGLE else turn

    def error(self, position: Array, rotation: Array) -> tuple[float, float]:
        """Return the distance to a pose, m and rad."""
        here, turned = self.sim.eef_pose()
        return length(position - here), length(rotation_vector(rotation @ turned.T))

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
    ) -> Steps:
        """Move to a fixed or moving pose.

        Stop after ``timeout`` steps, when ``give_up`` returns True, or after `STALL_STEPS` steps without progress.
        """
        best, since = np.inf, 0
        for _ in range(timeout):
            if give_up is not None and give_up():
                return
            goal = position() if callable(position) else position
            turn = rotation() if callable(rotation) else rotation
            excess = self.stretch(goal, turn) - MAX_STRETCH
            if excess > 0.0:
                goal = goal - min(excess, 0.05) * self.radial(goal)
            distance, angle = self.error(goal, turn)
            slow = tolerance >= PASSING_TOLERANCE or length(self._last[:3]) < ARRIVAL_ACTION
            if distance < tolerance and angle < turn_tolerance and slow:
                return
            left = distance + 0.1 * angle
            best, since = (left, 0) if left < best - 0.002 else (best, since + 1)
            if since > STALL_STEPS:
                return
            yield self.toward(goal, turn, gripper, speed)

    def lower(self, position: Target, rotation: Array, gripper: float, *, tolerance: float) -> Steps:
        """Lower slowly to a pose; stop when the hand no longer descends because something supports the load."""
        heights: list[float] = []
        for _ in range(60):
            goal = position()
            if self.error(goal, rotation)[0] < tolerance:
                return
            heights.append(float(self.position[2]))
            if len(heights) > 12 and heights[-9] - heights[-1] < 0.002:
                return
            yield self.toward(goal, rotation, gripper, 0.45)

    def wait(self, steps: int, gripper: float) -> Steps:
        """Hold the pose for some steps, for the fingers to move or an object to settle."""
        position, rotation = self.sim.eef_pose()
        for _ in range(steps):
            yield self.toward(position, rotation, gripper)

    def open(self, steps: int) -> Steps:
        """Open the fingers at rest for some steps; steps in which the gripper command does not open do not count."""
        position, rotation = self.sim.eef_pose()
        for _ in range(MAX_OPENING_STEPS):
            before = self.sim.gripper_command()
            yield self.toward(position, rotation, OPEN)
            now = self.sim.gripper_command()
            steps -= now < before or now <= OPEN
            if steps == 0:
                return

    def close(self, position: Target | None = None, rotation: Array | None = None) -> Steps:
        """Close the fingers, at rest or following a target, until they stop."""
        here, turned = self.sim.eef_pose()
        before = self.sim.gripper_opening()
        for step in range(24):
            goal = here if position is None else position()
            yield self.toward(goal, turned if rotation is None else rotation, CLOSED)
            now = self.sim.gripper_opening()
            if step >= 8 and before - now < 2e-4:
                return
            before = now
