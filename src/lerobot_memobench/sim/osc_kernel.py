"""Compiled part of `robot.Controller`: torques and finger commands of one physics step.

Sums are in a fixed order and use no BLAS, whose kernels differ between processors. So recorded actions give the same
states, bit for bit, on all x86-64 processors.

Source: robosuite 1.4.1 `controllers/osc.py`, `config/osc_pose.json`; Khatib 1987.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from mujoco_raster.compiled import compiled

KP, NULLSPACE_KP = 150.0, 10.0  # gains of the published, critically damped controller
KD, NULLSPACE_KD = float(2 * np.sqrt(KP)), float(2 * np.sqrt(NULLSPACE_KP))

exact = partial(compiled, fastmath=False)
"""Decorator of functions in which NaN may occur: of a singular matrix, which MuJoCo then reports."""


@exact
def _times(matrix, vector, out):  # type: ignore[no-untyped-def]
    """out = matrix @ vector, summed in order."""
    rows, columns = matrix.shape
    for row in range(rows):
        total = matrix[row, 0] * vector[0]
        for k in range(1, columns):
            total += matrix[row, k] * vector[k]
        out[row] = total


@exact
def _times_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """out = a @ b.T, summed in order."""
    for row in range(b.shape[0]):
        _times(a, b[row], out[:, row])


@exact
def _factorise(matrix, factor):  # type: ignore[no-untyped-def]
    """factor = lower Cholesky factor of a positive definite matrix, NaN for another."""
    rows = matrix.shape[0]
    for j in range(rows):
        for i in range(j, rows):
            rest = matrix[i, j]
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            if i > j:
                factor[i, j] = rest / factor[j, j]
            else:
                factor[j, j] = np.sqrt(rest) if rest > 0 else np.nan


@exact
def _solve(factor, b):  # type: ignore[no-untyped-def]
    """b = matrix⁻¹ b for the matrix of a Cholesky factor."""
    rows = b.size
    for j in range(rows):
        b[j] /= factor[j, j]
        for i in range(j + 1, rows):
            b[i] -= factor[i, j] * b[j]
    for j in range(rows - 1, -1, -1):
        b[j] /= factor[j, j]
        for i in range(j):
            b[i] -= factor[j, i] * b[j]


@exact
def _clip(value, low, high):  # type: ignore[no-untyped-def]
    """Return a value clipped to limits; NaN is unchanged."""
    return low if value < low else high if value > high else value


@exact
def _write_torques(qpos, qvel, bias, jacobian, mass, position, rotation, goal, goal_rotation, home, torques):  # type: ignore[no-untyped-def]
    """torques = unclipped torques (7,), Nm; arguments as of `write_controls`."""
    twist, wrench, pull, posture = np.empty(6), np.empty(6), np.empty(6), np.empty(7)
    turn, columns, inverse = np.empty((3, 3)), jacobian.copy(), np.empty((6, 6))
    third, sixth, seventh = np.empty((3, 3)), np.empty((6, 6)), np.empty((7, 7))
    _times(jacobian, qvel, twist)
    # robosuite's small-angle error: half the sum of cross products of the frames' axes.
    _times_transposed(goal_rotation, rotation, turn)
    for k in range(3):
        wrench[k] = KP * (goal[k] - position[k]) - KD * twist[k]
        after, last = (k + 1) % 3, (k + 2) % 3
        error = 0.5 * (turn[last, after] - turn[after, last])
        wrench[3 + k] = KP * error - KD * twist[3 + k]
    _factorise(mass, seventh)
    for k in range(6):
        _solve(seventh, columns[k])  # columns of M⁻¹ Jᵀ
    _times_transposed(jacobian, columns, inverse)
    for part in (slice(0, 3), slice(3, 6)):
        _factorise(inverse[part, part], third)
        _solve(third, wrench[part])
    # Nullspace: (I − Jᵀ Λ J M⁻¹) posture, with Λ the full task-space inertia.
    for k in range(7):
        torques[k] = NULLSPACE_KP * (home[k] - qpos[k]) - NULLSPACE_KD * qvel[k]
    _times(mass, torques, posture)
    _times(columns, posture, pull)
    _factorise(inverse, sixth)
    _solve(sixth, pull)
    for k in range(6):
        wrench[k] -= pull[k]
    _times(jacobian.T, wrench, torques)
    for k in range(7):
        torques[k] = torques[k] + bias[k] + posture[k]


@exact
def write_controls(  # type: ignore[no-untyped-def]
    qpos, qvel, bias, jacobian, mass, position, rotation, goal, goal_rotation, home,
    limits, arm_ctrl, finger_range, finger_ctrl, gripper, change, gravity_only,
):  # fmt: skip
    """Write the controls of one physics step to ``arm_ctrl`` (7,) and ``finger_ctrl`` (2,).

    ``qpos``, ``qvel``, ``bias``, ``home`` (7,): of the arm; the last is the angles of its posture. ``jacobian`` (6, 7),
    ``position``, ``rotation``, ``goal``, ``goal_rotation``: of the grip site. ``mass`` (7, 7). ``limits`` (2, 7) of the
    torques and ``finger_range`` (2, 2) of the targets: smallest, largest. ``gripper`` (2,): finger commands, updated in
    place by ``change`` (2,). ``gravity_only``: whether the torques only hold the arm against gravity.
    """
    torques = bias.copy()
    if not gravity_only:
        _write_torques(qpos, qvel, bias, jacobian, mass, position, rotation, goal, goal_rotation, home, torques)
    for k in range(7):
        arm_ctrl[k] = _clip(torques[k], limits[0, k], limits[1, k])
    for k in range(2):
        gripper[k] = _clip(gripper[k] + change[k], -1.0, 1.0)
        low, high = finger_range[0, k], finger_range[1, k]
        finger_ctrl[k] = (high + low) / 2 + (high - low) / 2 * gripper[k]
