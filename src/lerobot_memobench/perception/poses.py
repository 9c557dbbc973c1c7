"""Poses by formula: on the table in any turn, in the hand, and the arm's joints for a pose of the hand."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.assets.asset import Asset, Grasp
from lerobot_memobench.sim.placement import GAP
from lerobot_memobench.sim.robot import ARM_JOINTS, GRIP_SITE
from lerobot_memobench.sim.simulation import Simulation

Array = NDArray[np.float64]

AWAY = (30.0, 0.0, 5.0)
"""Where things are taken away to, m: no camera looks there, and no shadow of theirs falls on the table."""
ITERATIONS, STRIDE, DAMPING = 40, 0.25, 0.02
"""Of `reach`: how often it steps, by how much of a joint at most, rad, and what keeps it calm near straight poses."""
REACHED = 0.005
"""What `reach` may miss a pose by, m and rad together."""


def pose(position: Array, turn: Rotation) -> Array:
    """Return position and quaternion wxyz as one vector (7,)."""
    return np.concatenate([position, turn.as_quat(scalar_first=True)])


def away(index: int) -> Array:
    """Return a pose (7,) of its own for each thing that is taken away."""
    return pose(np.add(AWAY, [0.0, index, 0.0]), Rotation.identity())


def standing(asset: Asset, x: float, y: float, z: float, turn: Rotation) -> Array:
    """Return the pose (7,) of a thing turned in some way whose lowest corner is at a height z, m."""
    corners = np.array(list(itertools.product(*zip(asset.low, asset.high, strict=True))))
    return pose(np.array([x, y, z + GAP - turn.apply(corners)[:, 2].min()]), turn)


def held(grasp: Grasp, position: Array, rotation: Array) -> Array:
    """Return the pose (7,) of a thing that a hand at a pose holds by a grasp."""
    closing = np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    body = np.array([closing, np.cross(up, closing), up])
    turn = np.array([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]]).T @ body
    return pose(position - turn @ np.array(grasp.position), Rotation.from_matrix(turn))


def reach(sim: Simulation, position: Array, rotation: Array) -> bool:
    """Bend the arm until the hand is at a pose; return whether it got there. Only qpos is written, and kinematics."""
    model, data, site = sim.model, sim.data, sim.model.site(GRIP_SITE).id
    joints = [model.joint(name) for name in ARM_JOINTS]
    addresses, columns = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    low, high = np.array([joint.range for joint in joints]).T
    jacobian = np.zeros((6, model.nv))
    for _ in range(ITERATIONS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        here, turned = sim.eef_pose()
        missing = np.concatenate([position - here, Rotation.from_matrix(rotation @ turned.T).as_rotvec()])
        if np.abs(missing).max() < REACHED:
            return True
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        by = jacobian[:, columns]
        step = by.T @ np.linalg.solve(by @ by.T + DAMPING**2 * np.eye(6), missing)
        step *= min(1.0, STRIDE / np.abs(step).max())
        data.qpos[addresses] = np.clip(data.qpos[addresses] + step, low, high)
    return False
