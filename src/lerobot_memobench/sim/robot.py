"""Load and control the arm of the published stack: robosuite's Panda on the RethinkMount with the PandaGripper.

`panda` contains the arm of robosuite 1.4.0, which LIBERO uses. `scripts/robosuite_arm.py` writes it.
"""

from __future__ import annotations

import math
from functools import cache
from html import escape
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import CONTROL_HZ

Array = NDArray[np.float64]

FOLDER = Path(__file__).with_name("panda")  # folder of the arm's MJCF and meshes
BASE_POSITION = (-0.66, 0.0, 0.0)
"""Base of the mount, m: x = −0.16 − table length / 2 (robosuite's offset for a table of 1 m)."""
ARM_START = (0.0, -0.161037389, 0.0, -2.44459747, 0.0, 2.22675220, np.pi / 4)
"""Joint angles at reset, rad (LIBERO's mounted Panda)."""
GRIPPER_START = (0.020833, -0.020833)  # finger positions at reset, m
GRIPPER_OPEN = (0.04, -0.04)
"""Finger positions of the open hand, m. Opening fingers approach them for seconds; strict episodes start there, so that
the finger positions do not reveal the time since they were closed."""
ARM_JOINTS = tuple(f"robot0_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("gripper0_finger_joint1", "gripper0_finger_joint2")
ARM, FINGERS, OTHERS = slice(0, 7), slice(7, 9), slice(9, None)
"""Arm, fingers and other joints in qpos and qvel, the first two also in ctrl: the robot comes first in each model."""
GRIP_SITE = "gripper0_grip_site"
HAND_BODY = "robot0_right_hand"
WRIST_CAMERA = "robot0_eye_in_hand"

PHYSICS_STEP = 0.002
SUBSTEPS = round(1 / (CONTROL_HZ * PHYSICS_STEP))
POSITION_SCALE, ROTATION_SCALE = 0.05, 0.5  # metres and radians per unit of action
CLOSING_SIGNS = np.array([-1.0, 1.0])  # signs of the finger commands that close the gripper
GRIPPER_SPEED = 0.01  # change of the gripper command (−1 open … 1 closed) per physics step

MUJOCO = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
FULLM_READS_DATA = MUJOCO >= (3, 10)
"""`mujoco.mj_fullM` takes (model, data, result); before MuJoCo 3.10 it took (model, result, data.qM)."""
FULL_DEPTH_SINCE = (3, 4)  # first version of MuJoCo that reports the full depth of contacts between boxes


@cache
def robot_xml() -> str:
    """Return the MJCF of the arm and robosuite's physics options, with absolute file paths."""
    return (FOLDER / "panda.xml").read_text(encoding="utf-8").replace('file="', f'file="{escape(str(FOLDER))}/')


def hide_helpers(spec: mujoco.MjSpec) -> None:
    """Hide the arm's debugging sites, and disable contacts of its visual geoms."""
    for geom in spec.geoms:
        if geom.meshname and "vis" not in geom.meshname and geom.group == 1:
            geom.contype, geom.conaffinity = 0, 0
    # Cameras of the published stack do not show robosuite's grip site and axes.
    for site in spec.sites:
        site.group = 4


class Controller:
    """Move the arm of a compiled scene: operational-space control with the parameters of robosuite's OSC_POSE.

    A control step sets a goal from a 7-D action and holds it over the physics steps. The torques equal those of
    robosuite 1.4.1 (tested along a trajectory) without the overhead of the published stack: a second `mj_forward` per
    physics step, string look-ups, mass matrix copies, and pseudo-inverses of matrices that are regular in reach.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        from lerobot_memobench.sim.osc_kernel import write_controls  # loads numba

        self._write_controls = write_controls
        self._model = model
        self._site = model.site(GRIP_SITE).id
        self._torque_limits = model.actuator_ctrlrange[ARM].T.copy()
        self._finger_range = model.actuator_ctrlrange[FINGERS].T.copy()
        self._home = np.array(ARM_START)
        self._jacobian, self._mass = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
        self.goal_position: Array = np.zeros(3)
        self.goal_rotation = np.eye(3)
        self.gripper: Array = np.zeros(2)

    def reset(self, data: mujoco.MjData) -> None:
        """Hold the present pose with the gripper command at mid-range."""
        self.goal_position = data.site_xpos[self._site].copy()
        self.goal_rotation = data.site_xmat[self._site].reshape(3, 3).copy()
        self.gripper = np.zeros(2)

    def set_goal(self, data: mujoco.MjData, action: Array) -> None:
        """Set the goal to the present pose moved by ``action[:6]``, clipped to [−1, 1]."""
        delta = np.clip(action[:6], -1.0, 1.0)
        self.goal_position = data.site_xpos[self._site] + delta[:3] * POSITION_SCALE
        rotation = delta[3:] * ROTATION_SCALE
        if np.any(np.abs(rotation) > 0.0):  # else the orientation stays, as in the published controller
            turn, present = _rotation_matrix(rotation), data.site_xmat[self._site].reshape(3, 3)
            # The product in this order: BLAS sums in another one on each processor.
            self.goal_rotation = turn[:, :1] * present[:1] + turn[:, 1:2] * present[1:2] + turn[:, 2:] * present[2:]

    def advance(
        self, data: mujoco.MjData, gripper_action: float, substeps: int = SUBSTEPS, *, gravity_only: bool = False
    ) -> None:
        """Hold the goal, or the arm against gravity only; ``data`` is in the state after `mj_step1`, as later."""
        change = CLOSING_SIGNS * (GRIPPER_SPEED * np.sign(gripper_action))
        gripper, site, jacobian, mass = self.gripper.copy(), self._site, self._jacobian, self._mass
        linear, angular = jacobian[:3], jacobian[3:]
        # Views in each call: a copied simulation has its own memory.
        state = data.qpos[ARM], data.qvel[ARM], data.qfrc_bias[ARM], jacobian[:, ARM], mass[ARM, ARM]
        pose = data.site_xpos[site], data.site_xmat[site].reshape(3, 3), self.goal_position, self.goal_rotation
        arm, fingers = (self._torque_limits, data.ctrl[ARM]), (self._finger_range, data.ctrl[FINGERS])
        for _ in range(substeps):
            mujoco.mj_jacSite(self._model, data, linear, angular, site)
            if FULLM_READS_DATA:
                mujoco.mj_fullM(self._model, data, mass)
            else:
                mujoco.mj_fullM(self._model, mass, data.qM)
            self._write_controls(*state, *pose, self._home, *arm, *fingers, gripper, change, gravity_only)
            mujoco.mj_step2(self._model, data)
            mujoco.mj_step1(self._model, data)
        self.gripper = gripper

    def settle(self, data: mujoco.MjData, first: bool) -> None:
        """Advance one control step without motion after a stored state of LIBERO's suites, with an open gripper."""
        # `set_init_state` moves the arm, and robosuite's controller reads the new pose only after the first physics
        # step, in which it exerts no torque but that against gravity. In the first control step it returns to the pose
        # of its reset.
        if not first:
            self.set_goal(data, np.zeros(6))
        for substep in range(SUBSTEPS):
            # Stock LIBERO's MuJoCo reports half the depth of contacts between boxes. In some states groceries are 29 mm
            # inside the table; at full depth they would leave it twice as fast and be in the air after these steps.
            if MUJOCO >= FULL_DEPTH_SINCE:
                _halve_depth_of_boxes(self._model, data)
            self.advance(data, -1.0, 1, gravity_only=first and substep == 0)


def _rotation_matrix(rotation_vector: Array) -> Array:
    """Return the rotation (3, 3) about a vector by its length, rad."""
    x, y, z = map(float, rotation_vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        return np.eye(3)
    vector = math.sin(angle / 2) / angle * np.asarray(rotation_vector)
    # In single precision like robosuite; in double precision the torques would differ in the sixth digit.
    quaternion = np.array([math.cos(angle / 2), *vector], dtype=np.float32)
    scale = math.sqrt(2.0 / float(sum(quaternion * quaternion)))
    quaternion = (quaternion.astype(np.float64) * scale).astype(np.float32)
    # Doubled products of the quaternion's components; only the diagonal's sums are in double precision.
    p = np.outer(quaternion, quaternion)
    d = p.diagonal().astype(np.float64)
    return np.array(
        [
            [1 - d[2] - d[3], p[1, 2] - p[0, 3], p[1, 3] + p[0, 2]],
            [p[1, 2] + p[0, 3], 1 - d[1] - d[3], p[2, 3] - p[0, 1]],
            [p[1, 3] - p[0, 2], p[2, 3] + p[0, 1], 1 - d[1] - d[2]],
        ],
        dtype=np.float64,
    )


def _halve_depth_of_boxes(model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Halve the depth of contacts between boxes in the reference acceleration of their constraints."""
    boxes = (model.geom_type[data.contact.geom] == mujoco.mjtGeom.mjGEOM_BOX.value).all(axis=1)
    rows = data.contact.efc_address[boxes & (data.contact.efc_address >= 0)]
    # The impedance is that of the full depth, which is equal for contacts deeper than 2 mm.
    stiffness, _, impedance, _ = data.efc_KBIP[rows].T
    data.efc_aref[rows] += 0.5 * stiffness * impedance * (data.efc_pos[rows] - data.efc_margin[rows])
