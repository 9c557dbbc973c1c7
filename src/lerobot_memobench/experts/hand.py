"""From where the hand should be to what a policy would have to output: smooth actions inside [−1, 1]."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.controller import POSITION_SCALE, ROTATION_SCALE
from lerobot_memobench.sim.robot import ARM_JOINTS
from lerobot_memobench.sim.simulation import Simulation

Array = NDArray[np.float64]
Steps = Generator[NDArray[np.float32], None, None]
"""A motion, or a part of one: yields actions (7,), each computed from the state at the time it is asked for."""
Target = Callable[[], Array]
"""A position (3,) or rotation (3, 3) that may move while it is being reached."""

OPEN, CLOSED = -1.0, 1.0
DOWN = np.array([0.0, 0.0, -1.0])
UP = np.array([0.0, 0.0, 1.0])

COARSE = 0.02
"""Tolerance from which a place only has to be passed, m."""
ROTATION_SPEED = 0.35
"""Largest angular action."""
SLOW = 0.4
"""Linear action under which a hand that arrives does not shoot past."""
PATIENCE = 25
"""Steps without getting nearer after which a hand is taken to be stopped by something."""
SHOULDER = "robot0_link2"
"""The body whose origin is where the arm's shoulder turns."""
FLANGE, ELL = 0.2035, 0.088
"""From the grip site back to the last joint and from there sideways to the wrist, m."""
STRETCHED = 0.70
"""Distance from shoulder to wrist that the arm should not exceed, m: at 0.719 it is straight."""
COMFORTABLE = 0.685
"""Distance from shoulder to wrist up to which the arm is as good as anywhere, m."""
ELBOW_STRAIGHT = -0.42
"""Angle of the elbow above which the arm is bent the wrong way round its straight pose, rad."""
EMPTY = 0.003
"""Opening under which the fingers hold nothing, m."""
LATE = 40
"""Most steps for which fingers are told to open, before the hand goes on."""
LAST_JOINT_STOP = 2.75
"""How far the last joint of the arm is turned at most, rad; it turns with the hand about the fingers' direction."""


def cross(a: Array, b: Array) -> Array:
    """Return the cross product of two vectors (3,); numpy's own takes fifty times as long for so little."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def length(vector: Array) -> float:
    """Return the length of a vector."""
    return math.sqrt(float(vector @ vector))


def unit(vector: Array) -> Array:
    """Return a vector at length 1; a vector of length 0 stays."""
    return vector / max(length(vector), 1e-9)


def frame(approach: Array, closing: Array) -> Array:
    """Return the hand's rotation (3, 3): z along ``approach`` (out of the palm), x along which the fingers close."""
    z = unit(np.asarray(approach, dtype=np.float64))
    x = np.asarray(closing, dtype=np.float64)
    x = unit(x - z * (x @ z))
    return np.array([x, cross(z, x), z]).T


def rotation_vector(matrix: Array) -> Array:
    """Return the rotation vector (3,), rad, of a rotation matrix (3, 3)."""
    # SciPy's checks of the matrix take twice the time of the rest, and change nothing for a rotation.
    return Rotation.from_matrix(matrix, assume_valid=True).as_rotvec()


EASY_CLOSING = np.array([-0.5, np.sqrt(0.75), 0.0])
"""Closing direction of a hand that points down, at which the last joint of the arm is in its middle."""


def downward(yaw: float) -> Array:
    """Return the rotation of a hand that points down, its fingers closing along the horizontal angle ``yaw``, rad.

    A parallel gripper does not care which finger is which: of the two half turns the one that leaves the last joint
    of the arm farther from its stops is taken.
    """
    closing = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    return frame(DOWN, closing if closing @ EASY_CLOSING >= 0 else -closing)


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
        self._last: Array = np.zeros(6)

    @property
    def position(self) -> Array:
        """Where the grip site is, (3,), m."""
        return self.sim.eef_pose()[0]

    @property
    def rotation(self) -> Array:
        """How the hand is turned, (3, 3)."""
        return self.sim.eef_pose()[1]

    @property
    def empty(self) -> bool:
        """Whether the fingers have closed on each other."""
        return self.sim.gripper_opening() <= EMPTY

    def toward(self, position: Array, rotation: Array, gripper: float, speed: float = 1.0) -> NDArray[np.float32]:
        """Return the action (7,) that brings the hand nearer to a pose."""
        here, turned = self.sim.eef_pose()
        if self.sim.data.joint(ARM_JOINTS[3]).qpos[0] > ELBOW_STRAIGHT:
            # Through the straight pose: only from stretched the elbow bends back the right way.
            position = here + 0.04 * self.radial(here)
        linear = (position - here) / POSITION_SCALE
        limit = self.speed * speed
        linear *= min(1.0, limit / max(length(linear), 1e-9))
        angular = self._turn(rotation, turned) / ROTATION_SCALE
        angular *= min(1.0, ROTATION_SPEED / max(length(angular), 1e-9))
        wanted = np.concatenate([linear, angular])
        self._last = self._last + np.clip(wanted - self._last, -self.slew, self.slew)
        return np.append(self._last, gripper).astype(np.float32)

    def rest(self, gripper: float) -> NDArray[np.float32]:
        """Return the action (7,) that lets the present motion run out."""
        self._last = self._last - np.clip(self._last, -self.slew, self.slew)
        return np.append(self._last, gripper).astype(np.float32)

    def radial(self, place: Array) -> Array:
        """Return the level direction (3,) from the arm's foot to a place."""
        return unit((place - self.sim.data.body(SHOULDER).xpos) * np.array([1.0, 1.0, 0.0]))

    def stretch(self, position: Array, rotation: Array) -> float:
        """Return the distance from shoulder to wrist when the hand is at a pose, m."""
        inward = -self.radial(position)
        inward = unit(inward - rotation[:, 2] * (inward @ rotation[:, 2]))
        wrist = position - FLANGE * rotation[:, 2] + ELL * inward
        return length(wrist - self.sim.data.body(SHOULDER).xpos)

    def _turn(self, rotation: Array, turned: Array) -> Array:
        """Return the rotation vector (3,), rad, to an orientation: the short way, if the last joint allows it."""
        turn = rotation_vector(rotation @ turned.T)
        angle = length(turn)
        last = float(self.sim.data.joint(ARM_JOINTS[-1]).qpos[0]) + turn @ turned[:, 2]
        return turn * (1.0 - 2 * np.pi / angle) if angle > 1.5 and abs(last) > LAST_JOINT_STOP else turn

    def error(self, position: Array, rotation: Array) -> tuple[float, float]:
        """Return the distance to a pose, m and rad."""
        here, turned = self.sim.eef_pose()
        angle = length(rotation_vector(rotation @ turned.T))
        return length(position - here), angle

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
        """Go to a pose, following it where it moves.

        Stop after ``timeout`` steps, when ``give_up`` says so, or when for `PATIENCE` steps it got no nearer.
        """
        best, since = np.inf, 0
        for _ in range(timeout):
            if give_up is not None and give_up():
                return
            goal = position() if callable(position) else position
            turn = rotation() if callable(rotation) else rotation
            excess = self.stretch(goal, turn) - STRETCHED
            if excess > 0.0:
                goal = goal - min(excess, 0.05) * self.radial(goal)
            distance, angle = self.error(goal, turn)
            slow = tolerance >= COARSE or length(self._last[:3]) < SLOW
            if distance < tolerance and angle < turn_tolerance and slow:
                return
            left = distance + 0.1 * angle
            best, since = (left, 0) if left < best - 0.002 else (best, since + 1)
            if since > PATIENCE:
                return
            yield self.toward(goal, turn, gripper, speed)

    def lower(self, position: Target, rotation: Array, gripper: float, *, tolerance: float) -> Steps:
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

    def wait(self, steps: int, gripper: float) -> Steps:
        """Hold still for some steps, for the fingers to move or a thing to settle."""
        position, rotation = self.sim.eef_pose()
        for _ in range(steps):
            yield self.toward(position, rotation, gripper)

    def open(self, steps: int) -> Steps:
        """Open the fingers at rest for some steps; such in which they were kept shut all the same do not count."""
        position, rotation = self.sim.eef_pose()
        for _ in range(LATE):
            before = self.sim.gripper_command()
            yield self.toward(position, rotation, OPEN)
            now = self.sim.gripper_command()
            steps -= now < before or now <= OPEN
            if steps == 0:
                return

    def close(self, position: Target | None = None, rotation: Array | None = None) -> Steps:
        """Close the fingers, at rest or following a target, until they stop on something or on each other."""
        here, turned = self.sim.eef_pose()
        before = self.sim.gripper_opening()
        for step in range(24):
            goal = here if position is None else position()
            yield self.toward(goal, turned if rotation is None else rotation, CLOSED)
            now = self.sim.gripper_opening()
            if step >= 8 and before - now < 2e-4:
                return
            before = now
