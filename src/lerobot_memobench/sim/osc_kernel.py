"""Compiled loop of `OSCController.advance`: the same operations in the same order, so the result is equal to the bit.

MuJoCo is called by address. All memory passed to it belongs to the caller, because arrays created here may be freed
while their address is in use. The import requires a cache folder for numba.
"""

from __future__ import annotations

import ctypes
import importlib
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Functions(NamedTuple):
    """Addresses of the called C functions."""

    step1: int
    step2: int
    site_jacobian: int
    full_mass: int


class Arm(NamedTuple):
    """Constants of a controller: MuJoCo signature, indices of site, velocities and positions, gains, limits, motors."""

    mass_by_data: bool
    site: int
    dof: int
    qpos: int
    kp: float
    kd: float
    null_kp: float
    null_kd: float
    home: Array
    low: Array
    high: Array
    finger_bias: Array
    finger_scale: Array
    actuators: NDArray[np.int64]
    fingers: NDArray[np.int64]


class State(NamedTuple):
    """Views of the simulation: positions, velocities, pose of the grip site, mass matrix, bias forces, controls."""

    qpos: Array
    qvel: Array
    position: Array
    rotation: Array
    mass: Array
    bias: Array
    ctrl: Array


class Scratch(NamedTuple):
    """Buffers for intermediate results, created by `scratch`."""

    jacobian: Array
    mass: Array
    factors: tuple[Array, Array, Array]
    twist: Array
    product: Array
    columns: Array
    inverse: Array
    wrench: Array
    pull: Array
    posture: Array
    torques: Array


def functions() -> Functions:
    """Return the addresses of the functions that MuJoCo's bindings call.

    Raises:
        AttributeError: a symbol is missing.
    """
    # An extension module resolves symbols of its linked libraries.
    physics = ctypes.CDLL(importlib.import_module("mujoco._functions").__file__)

    def address(function: Any) -> int:
        return int(ctypes.cast(function, ctypes.c_void_p).value or 0)

    return Functions(
        address(physics.mj_step1),
        address(physics.mj_step2),
        address(physics.mj_jacSite),
        address(physics.mj_fullM),
    )


def scratch(nv: int) -> Scratch:
    """Return buffers for a model with ``nv`` degrees of freedom."""
    empty = np.empty
    return Scratch(
        empty((6, nv)), empty((nv, nv)), (empty((3, 3)), empty((6, 6)), empty((7, 7))), empty(6), empty((3, 3)),
        empty((6, 7)), empty((6, 6)), empty(6), empty(6), empty(7), empty(7),
    )  # fmt: skip


def _call_of(_typing: Any, address: Any, arguments: Any) -> Any:
    """Call a C function without return value. Unlike ctypes functions it can be stored in numba's cache."""

    def generate(context: Any, builder: Any, _signature: Any, values: Any) -> Any:
        pointer, packed = values
        passed = [builder.extract_value(packed, k) for k in range(len(arguments))]
        kind = ir.FunctionType(ir.VoidType(), [value.type for value in passed])
        builder.call(builder.inttoptr(pointer, kind.as_pointer()), passed)
        return context.get_dummy_value()

    return types.void(address, arguments), generate


_call: Any = intrinsic(_call_of)


@njit(nogil=True)
def _times(matrix, vector, out):  # type: ignore[no-untyped-def]
    """out = matrix @ vector, summed in order."""
    rows, columns = matrix.shape
    for row in range(rows):
        total = matrix[row, 0] * vector[0]
        for k in range(1, columns):
            total += matrix[row, k] * vector[k]
        out[row] = total


@njit(nogil=True)
def _times_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """out = a @ b.T, summed in order."""
    for row in range(b.shape[0]):
        _times(a, b[row], out[:, row])


@njit(nogil=True)
def _factorise(matrix, factor):  # type: ignore[no-untyped-def]
    """factor = lower Cholesky factor of a positive definite matrix."""
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


@njit(nogil=True)
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


@njit(nogil=True)
def _clip(value, low, high):  # type: ignore[no-untyped-def]
    """Return a value clipped to limits; NaN is unchanged."""
    return low if value < low else high if value > high else value


@njit(nogil=True)
def _torques(f, model, data, arm, position, rotation, x, s):  # type: ignore[no-untyped-def]
    """s.torques = `OSCController.torques`."""
    _call(
        f.site_jacobian,
        (model, data, s.jacobian.ctypes.data, s.jacobian[3:].ctypes.data, np.int32(arm.site)),
    )
    if arm.mass_by_data:
        _call(f.full_mass, (model, data, s.mass.ctypes.data))
    else:
        _call(f.full_mass, (model, s.mass.ctypes.data, x.mass.ctypes.data))
    dofs = slice(arm.dof, arm.dof + 7)
    jacobian, mass, velocity = s.jacobian[:, dofs], s.mass[dofs, dofs], x.qvel[dofs]
    third, sixth, seventh = s.factors
    _times(jacobian, velocity, s.twist)
    _times_transposed(rotation, x.rotation, s.product)
    for k in range(3):
        s.wrench[k] = arm.kp * (position[k] - x.position[k]) - arm.kd * s.twist[k]
        after, last = (k + 1) % 3, (k + 2) % 3
        error = 0.5 * (s.product[last, after] - s.product[after, last])
        s.wrench[3 + k] = arm.kp * error - arm.kd * s.twist[3 + k]

    for k in range(6):
        for j in range(7):
            s.columns[k, j] = jacobian[k, j]
    _factorise(mass, seventh)
    for k in range(6):
        _solve(seventh, s.columns[k])
    _times_transposed(jacobian, s.columns, s.inverse)
    for part in (slice(0, 3), slice(3, 6)):
        _factorise(s.inverse[part, part], third)
        _solve(third, s.wrench[part])
    for k in range(7):
        s.torques[k] = arm.null_kp * (arm.home[k] - x.qpos[arm.qpos + k]) - arm.null_kd * velocity[k]
    _times(mass, s.torques, s.posture)
    _times(s.columns, s.posture, s.pull)
    _factorise(s.inverse, sixth)
    _solve(sixth, s.pull)
    for k in range(6):
        s.wrench[k] -= s.pull[k]
    _times(jacobian.T, s.wrench, s.torques)
    for k in range(7):
        s.torques[k] = s.torques[k] + x.bias[arm.dof + k] + s.posture[k]


@njit(nogil=True, cache=True)
def advance(f, model, data, arm, position, rotation, gripper, moved, x, s, substeps):  # type: ignore[no-untyped-def]
    """Hold a goal over physics steps.

    Args:
        f: `Functions`.
        model, data: addresses of MuJoCo's structures.
        arm: `Arm`.
        position, rotation: the goal, (3,) and (3, 3).
        gripper: finger commands, (2,), updated in place.
        moved: change of the finger commands per physics step, (2,).
        x: `State`.
        s: `Scratch`.
        substeps: number of physics steps.
    """
    for _ in range(substeps):
        _torques(f, model, data, arm, position, rotation, x, s)
        for k in range(7):
            x.ctrl[arm.actuators[k]] = _clip(s.torques[k], arm.low[k], arm.high[k])
        for k in range(2):
            gripper[k] = _clip(gripper[k] + moved[k], -1.0, 1.0)
            x.ctrl[arm.fingers[k]] = arm.finger_bias[k] + arm.finger_scale[k] * gripper[k]
        _call(f.step2, (model, data))
        _call(f.step1, (model, data))
