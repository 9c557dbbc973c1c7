"""Operational-space control of the arm with the parameters of robosuite's OSC_POSE controller.

A control step sets a goal from a 7-D action and holds it over the physics steps. The torques equal those of robosuite
1.4.1 (tested along a trajectory) without the overhead of the published stack: a second `mj_forward` per physics step,
string look-ups, full-model Jacobians, mass matrix copies, and pseudo-inverses of matrices that are regular in reach.

Sums are in a fixed order and use no BLAS, whose kernels differ between processors. So recorded actions give the same
states, to the bit, on all x86-64 processors.

`make_controller` compiles a control step into one call if that reproduces the bits of the numpy controller, because
Python and numpy take most of a control step's time. The first step of a process runs both ways; after a difference or a
failure the process uses numpy.

Source: robosuite 1.4.1 `controllers/osc.py`, `config/osc_pose.json`; Khatib 1987.
"""

from __future__ import annotations

import copy
import logging
import math

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim import robot

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]


CLOSING_SIGNS = np.array([-1.0, 1.0])
"""Signs of the finger commands that close the gripper."""
KP, NULLSPACE_KP = 150.0, 10.0
"""Gains of the published, critically damped controller."""
KD, NULLSPACE_KD = 2 * np.sqrt(KP), 2 * np.sqrt(NULLSPACE_KP)
POSITION_SCALE, ROTATION_SCALE = 0.05, 0.5
"""Metres and radians per unit of action."""
GRIPPER_SPEED = 0.01
"""Change of the gripper command (−1 open … 1 closed) per physics step."""

MUJOCO = tuple(int(part) for part in mujoco.__version__.split(".")[:2])
FULLM_READS_DATA = MUJOCO >= (3, 10)
"""`mujoco.mj_fullM` takes (model, data, result); before MuJoCo 3.10 it took (model, result, data.qM)."""
NEWEST_MUJOCO = (4, 0)
"""Newest MuJoCo version whose functions are called by address; signatures of later versions may differ."""


class OSCController:
    """Convert 7-D actions into joint torques and finger targets of one model.

    Args:
        model: compiled scene with the arm of `sim.robot`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model = model
        joints = [model.joint(name).id for name in robot.ARM_JOINTS]
        self._qpos = model.jnt_qposadr[joints]
        self._dof = model.jnt_dofadr[joints]
        first = int(self._dof[0])
        # The arm comes first in the model, so its rows are slices, which are cheaper than index arrays.
        self._dofs = slice(first, first + len(joints))
        self._qposs = slice(int(self._qpos[0]), int(self._qpos[0]) + len(joints))
        self._site = model.site(robot.GRIP_SITE).id
        self._arm = np.array([model.actuator(name).id for name in robot.ARM_ACTUATORS])
        self._fingers = np.array([model.actuator(name).id for name in robot.FINGER_ACTUATORS])
        self._torque_limits = model.actuator_ctrlrange[self._arm].T.copy()
        low, high = model.actuator_ctrlrange[self._fingers].T
        self._finger_bias, self._finger_scale = (high + low) / 2, (high - low) / 2
        self._home = np.array(robot.ARM_START)
        nv = model.nv
        self._jac = np.zeros((6, nv))
        self._mass = np.zeros((nv, nv))
        self.goal_position: Array = np.zeros(3)
        self.goal_rotation = np.eye(3)
        self.gripper: Array = np.zeros(2)

    def reset(self, data: mujoco.MjData) -> None:
        """Hold the present pose with the gripper command at mid-range."""
        self.goal_position = data.site_xpos[self._site].copy()
        self.goal_rotation = data.site_xmat[self._site].reshape(3, 3).copy()
        self.gripper = np.zeros(2)

    def set_goal(self, data: mujoco.MjData, action: Array) -> None:
        """Set the goal to the present pose moved by ``action[:6]``, clipped to [−1, 1].

        A zero rotation keeps the previous goal's orientation, as in the published controller.
        """
        delta = np.clip(action[:6], -1.0, 1.0)
        self.goal_position = data.site_xpos[self._site] + delta[:3] * POSITION_SCALE
        rotation = delta[3:] * ROTATION_SCALE
        if np.any(np.abs(rotation) > 0.0):
            present = data.site_xmat[self._site].reshape(3, 3)
            self.goal_rotation = product(rotation_matrix(rotation), present)

    def torques(self, data: mujoco.MjData) -> Array:
        """Return the arm's unclipped torques (7,), Nm, for the present state.

        ``data`` must hold the position and velocity stages of the present state (`mujoco.mj_step1`).
        """
        dofs = self._dofs
        mujoco.mj_jacSite(self._model, data, self._jac[:3], self._jac[3:], self._site)
        if FULLM_READS_DATA:
            mujoco.mj_fullM(self._model, data, self._mass)
        else:
            mujoco.mj_fullM(self._model, self._mass, data.qM)
        jacobian = self._jac[:, dofs]
        mass = self._mass[dofs, dofs]
        velocity = data.qvel[dofs]
        present = data.site_xmat[self._site].reshape(3, 3)
        twist = product(jacobian, velocity)
        force = KP * (self.goal_position - data.site_xpos[self._site]) - KD * twist[:3]
        torque = KP * orientation_error(self.goal_rotation, present) - KD * twist[3:]

        mass_inverse_jt = solution(mass, jacobian.T)
        inertia_inverse = product(jacobian, mass_inverse_jt)
        wrench = np.concatenate([solution(inertia_inverse[:3, :3], force), solution(inertia_inverse[3:, 3:], torque)])
        pull = NULLSPACE_KP * (self._home - data.qpos[self._qposs]) - NULLSPACE_KD * velocity
        posture = product(mass, pull)
        # Nullspace: (I − Jᵀ Λ J M⁻¹) posture, with Λ the full task-space inertia.
        wrench -= solution(inertia_inverse, product(mass_inverse_jt.T, posture))
        return product(jacobian.T, wrench) + data.qfrc_bias[dofs] + posture

    def apply(self, data: mujoco.MjData, gripper_action: float) -> None:
        """Write the controls for one physics step into ``data.ctrl``."""
        self._apply(data, self.torques(data), gripper_action)

    def apply_gravity(self, data: mujoco.MjData, gripper_action: float) -> None:
        """Write controls that only hold the arm against gravity, as `apply`."""
        self._apply(data, data.qfrc_bias[self._dofs], gripper_action)

    def _apply(self, data: mujoco.MjData, torques: Array, gripper_action: float) -> None:
        low, high = self._torque_limits
        data.ctrl[self._arm] = np.minimum(np.maximum(torques, low), high)
        moved = self.gripper + self.gripper_change(gripper_action)
        self.gripper = np.minimum(np.maximum(moved, -1.0), 1.0)
        data.ctrl[self._fingers] = self._finger_bias + self._finger_scale * self.gripper

    def gripper_change(self, gripper_action: float) -> Array:
        """Return the change (2,) of the finger commands in one physics step."""
        change: Array = CLOSING_SIGNS * (GRIPPER_SPEED * np.sign(gripper_action))
        return change

    def advance(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        """Hold the goal over physics steps; before and after, ``data`` is in the state that `torques` requires."""
        for _ in range(substeps):
            self.apply(data, gripper_action)
            mujoco.mj_step2(self._model, data)
            mujoco.mj_step1(self._model, data)


def product(a: Array, b: Array) -> Array:
    """Return ``a @ b`` for a (n, k) and b (k,) or (k, m), summed in order, which BLAS does not guarantee."""
    columns = b[:, None] if b.ndim == 1 else b
    total = a[:, :1] * columns[:1]
    for k in range(1, len(columns)):
        total = total + a[:, k : k + 1] * columns[k : k + 1]
    return total.reshape(len(a), *b.shape[1:])


def solution(matrix: Array, b: Array) -> Array:
    """Return matrix⁻¹ b for a positive definite matrix (n, n) and b (n,) or (n, m), by Cholesky; NaN for another."""
    rest, found = matrix.copy(), np.array(b, dtype=np.float64).reshape(len(b), -1)
    last = len(matrix) - 1
    for j in range(last + 1):
        rest[j, j] = math.sqrt(rest[j, j]) if rest[j, j] > 0 else math.nan
        rest[j + 1 :, j] /= rest[j, j]
        rest[j + 1 :, j + 1 :] -= rest[j + 1 :, j : j + 1] * rest[j + 1 :, j]
    for j in range(last + 1):
        found[j] /= rest[j, j]
        found[j + 1 :] -= rest[j + 1 :, j : j + 1] * found[j]
    for j in range(last, -1, -1):
        found[j] /= rest[j, j]
        found[:j] -= rest[j, :j, None] * found[j]
    return found.reshape(b.shape)


def orientation_error(desired: Array, present: Array) -> Array:
    """Return robosuite's small-angle rotation error (3,): half the sum of cross products of the frames' axes."""
    p = product(desired, present.T)
    return 0.5 * np.array([p[2, 1] - p[1, 2], p[0, 2] - p[2, 0], p[1, 0] - p[0, 1]])


def rotation_matrix(rotation_vector: Array) -> Array:
    """Return the rotation (3, 3) about a vector by its length, rad.

    The computation uses a single-precision quaternion like robosuite; in double precision the torques would differ in
    the sixth digit.
    """
    x, y, z = map(float, rotation_vector)
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-9:
        return np.eye(3)
    vector = math.sin(angle / 2) / angle * np.asarray(rotation_vector)
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


# --- compiled ---


class _Process:
    """Result of the first step of this process, which runs both ways: None before it, then whether the bits agree."""

    agrees: bool | None = None


def make_controller(model: mujoco.MjModel) -> OSCController:
    """Return the fastest controller that works on this machine; all return the same bits."""
    if _Process.agrees is not False:
        try:
            return CompiledController(model)
        except Exception as error:  # no cache folder for numba, another BLAS or libc, ...: many exception types
            _fall_back(error)
    return OSCController(model)


def _fall_back(reason: object) -> None:
    _Process.agrees = False
    _log.debug("use the numpy controller: %s", reason)


class CompiledController(OSCController):
    """`OSCController` with a compiled `advance`.

    Raises:
        RuntimeError, AttributeError: numba has no cache folder, numpy uses another BLAS, or MuJoCo is newer than
            `NEWEST_MUJOCO`.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        if MUJOCO > NEWEST_MUJOCO:
            raise RuntimeError(f"MuJoCo {mujoco.__version__} is newer than {NEWEST_MUJOCO}")
        from lerobot_memobench.sim import osc_kernel

        super().__init__(model)
        self._functions = osc_kernel.functions()
        self._scratch = osc_kernel.scratch(model.nv)
        low, high = self._torque_limits
        self._constants = osc_kernel.Arm(
            mass_by_data=FULLM_READS_DATA,
            site=self._site,
            dof=self._dofs.start,
            qpos=self._qposs.start,
            kp=KP,
            kd=float(KD),
            null_kp=NULLSPACE_KP,
            null_kd=float(NULLSPACE_KD),
            home=self._home,
            low=low.copy(),
            high=high.copy(),
            finger_bias=self._finger_bias,
            finger_scale=self._finger_scale,
            actuators=self._arm,
            fingers=self._fingers,
        )

    def advance(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        """Advance as `OSCController.advance`."""
        # MuJoCo's bindings raise on its fatal errors; a call by address would end the process. The only fatal error
        # possible here is exhausted memory.
        if _Process.agrees is False or 2 * data.maxuse_arena > data.narena:
            super().advance(data, gripper_action, substeps)
        elif _Process.agrees is None:
            self._advance_both_ways(data, gripper_action, substeps)
        else:
            self._advance(data, gripper_action, substeps)

    def _advance(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        from lerobot_memobench.sim import osc_kernel

        # Read the addresses in each call: a copied simulation has its own memory.
        state = osc_kernel.State(
            data.qpos, data.qvel, data.site_xpos[self._site], data.site_xmat[self._site].reshape(3, 3),
            data.M if FULLM_READS_DATA else data.qM, data.qfrc_bias, data.ctrl,
        )  # fmt: skip
        gripper = self.gripper.copy()
        osc_kernel.advance(
            self._functions, self._model._address, data._address, self._constants,
            np.ascontiguousarray(self.goal_position), np.ascontiguousarray(self.goal_rotation), gripper,
            self.gripper_change(gripper_action), state, self._scratch, substeps,
        )  # fmt: skip
        self.gripper = gripper

    def _advance_both_ways(self, data: mujoco.MjData, gripper_action: float, substeps: int) -> None:
        """Advance with numpy and compiled code, and decide for the process; numpy's result is the reference."""
        before, reference = self.gripper, copy.copy(data)
        super().advance(reference, gripper_action, substeps)
        after, self.gripper = self.gripper, before
        try:
            self._advance(data, gripper_action, substeps)
            _Process.agrees = _bits(data, self.gripper) == _bits(reference, after)
            reason: object = "the compiled step differs from numpy's"
        except Exception as error:  # numba compiles at the first call
            _Process.agrees, reason = False, error
        if not _Process.agrees:
            _fall_back(reason)
            mujoco.mj_copyData(data, self._model, reference)
            self.gripper = after


def _bits(data: mujoco.MjData, gripper: np.ndarray) -> bytes:
    return b"".join(part.tobytes() for part in (data.qpos, data.qvel, data.qacc_warmstart, data.ctrl, gripper))
