"""The arm moves as in the published stack; the compiled torques equal NumPy's."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim import robot
from lerobot_memobench.sim.osc_kernel import KD, KP, NULLSPACE_KD, NULLSPACE_KP
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS, Simulation
from tests.sim.conftest import BOWLS, DRAWER

FIGURES = Path(__file__).parent / "data" / "osc_trajectory.npz"
"""300 actions and, before each, end effector (position m, quaternion xyzw) and joints (rad) of the published stack's
arm after a reset and ten steps without motion."""


class Arm:
    """The arm alone, stepped as `Simulation.step` steps it."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data, self.controller = model, mujoco.MjData(model), robot.Controller(model)
        self.data.qpos[: robot.OTHERS.start] = [*robot.ARM_START, *robot.GRIPPER_START]
        mujoco.mj_step1(model, self.data)
        self.controller.reset(self.data)

    def step(self, action: np.ndarray) -> None:
        self.controller.set_goal(self.data, action)
        self.controller.advance(self.data, float(action[6]))


def angle_between(matrix: np.ndarray, quaternion_xyzw: np.ndarray) -> float:
    """Return the angle between two rotations, degrees."""
    expected = np.empty(9)
    mujoco.mju_quat2Mat(expected, quaternion_xyzw[[3, 0, 1, 2]])
    trace = float(np.sum(matrix * expected.reshape(3, 3)))
    return float(np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1))))


def test_arm_follows_the_published_stack(arm_model: mujoco.MjModel) -> None:
    figures = np.load(FIGURES)
    arm = Arm(arm_model)
    site, hand = arm_model.site(robot.GRIP_SITE).id, arm_model.body(robot.HAND_BODY).id
    for _ in range(STABILISATION_STEPS):
        arm.step(NO_OP)
    rotation = np.empty(9)
    for step, action in enumerate(figures["actions"]):
        distance = np.linalg.norm(arm.data.site_xpos[site] - figures["eef_pos"][step])
        mujoco.mju_quat2Mat(rotation, arm.data.xquat[hand])
        angle = angle_between(rotation.reshape(3, 3), figures["eef_quat"][step])
        assert distance < 0.001, f"step {step}: {1e3 * distance:.2f} mm apart"
        assert angle < 0.5, f"step {step}: {angle:.2f}° apart"
        arm.step(action)


def test_goals_and_gripper_follow_the_published_rules(arm_model: mujoco.MjModel) -> None:
    arm = Arm(arm_model)
    arm.controller.set_goal(arm.data, np.array([9.0, -9.0, 0, 0, 0, 0, 0]))
    moved = arm.controller.goal_position - arm.data.site_xpos[arm_model.site(robot.GRIP_SITE).id]
    np.testing.assert_allclose(moved, [0.05, -0.05, 0.0], atol=1e-12)
    for steps, gripper, expected in ((2, 1.0, [-0.5, 0.5]), (3, 1.0, [-1.0, 1.0]), (1, 0.0, [-1.0, 1.0])):
        for _ in range(steps):
            arm.step(np.array([0, 0, 0, 0, 0, 0, gripper]))
        np.testing.assert_allclose(arm.controller.gripper, expected)
    arm.step(np.array([0, 0, 0, 0, 0, 0.4, -1.0]))
    turned = arm.controller.goal_rotation.copy()
    arm.step(NO_OP)
    np.testing.assert_array_equal(arm.controller.goal_rotation, turned)


# --- compiled steps equal NumPy's bit for bit ---


class Reference(robot.Controller):
    """The controller in NumPy, with sums in the order of the compiled one."""

    def torques(self, data: mujoco.MjData) -> np.ndarray:
        """Return the arm's unclipped torques (7,), Nm, for the present state."""
        jacobian, full = np.zeros((6, self._model.nv)), np.zeros((self._model.nv, self._model.nv))
        mujoco.mj_jacSite(self._model, data, jacobian[:3], jacobian[3:], self._site)
        arguments = (data, full) if robot.FULLM_READS_DATA else (full, data.qM)
        mujoco.mj_fullM(self._model, *arguments)
        jacobian, mass, velocity = jacobian[:, robot.ARM], full[robot.ARM, robot.ARM], data.qvel[robot.ARM]
        turn = product(self.goal_rotation, data.site_xmat[self._site].reshape(3, 3).T)
        error = 0.5 * np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
        twist = product(jacobian, velocity)
        force = KP * (self.goal_position - data.site_xpos[self._site]) - KD * twist[:3]
        torque = KP * error - KD * twist[3:]
        columns = solution(mass, jacobian.T)
        inverse = product(jacobian, columns)
        wrench = np.concatenate([solution(inverse[:3, :3], force), solution(inverse[3:, 3:], torque)])
        pull = NULLSPACE_KP * (self._home - data.qpos[robot.ARM]) - NULLSPACE_KD * velocity
        posture = product(mass, pull)
        wrench -= solution(inverse, product(columns.T, posture))
        return product(jacobian.T, wrench) + data.qfrc_bias[robot.ARM] + posture

    def advance(
        self, data: mujoco.MjData, gripper_action: float, substeps: int = robot.SUBSTEPS, *, gravity_only: bool = False
    ) -> None:
        change = robot.CLOSING_SIGNS * robot.GRIPPER_SPEED * np.sign(gripper_action)
        (low, high), (shut, wide) = self._torque_limits, self._finger_range
        for _ in range(substeps):
            data.ctrl[robot.ARM] = np.clip(self.torques(data), low, high)
            self.gripper = np.clip(self.gripper + change, -1.0, 1.0)
            data.ctrl[robot.FINGERS] = (wide + shut) / 2 + (wide - shut) / 2 * self.gripper
            mujoco.mj_step2(self._model, data)
            mujoco.mj_step1(self._model, data)


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return ``a @ b`` for a (n, k) and b (k,) or (k, m), summed in order."""
    columns = b.reshape(len(b), -1)
    return sum(a[:, k : k + 1] * columns[k : k + 1] for k in range(len(b))).reshape(len(a), *b.shape[1:])


def solution(matrix: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return matrix⁻¹ b for a positive definite matrix (n, n) and b (n,) or (n, m), by Cholesky."""
    factor, x = matrix.copy(), b.reshape(len(b), -1).copy()
    for j in range(len(matrix)):
        factor[j, j] = np.sqrt(factor[j, j])
        factor[j + 1 :, j] /= factor[j, j]
        factor[j + 1 :, j + 1 :] -= factor[j + 1 :, j : j + 1] * factor[j + 1 :, j]
    for j in range(len(matrix)):
        x[j] /= factor[j, j]
        x[j + 1 :] -= factor[j + 1 :, j : j + 1] * x[j]
    for j in reversed(range(len(matrix))):
        x[j] /= factor[j, j]
        x[:j] -= factor[j, :j, None] * x[j]
    return x.reshape(b.shape)


@pytest.mark.parametrize("task", [DRAWER, BOWLS])
def test_compiled_steps_equal_numpy(simulate: Callable[..., Simulation], task: str) -> None:
    """The hand moves at random; every fourth action keeps the former orientation."""
    compiled, plain = simulate(task), simulate(task)
    plain._controller = Reference(plain.model)
    plain.restore(compiled.snapshot())
    moves = np.random.default_rng(0).uniform(-1, 1, (60, 7))
    moves[::4, 3:6] = 0.0
    for k, move in enumerate(moves):
        for sim in (compiled, plain):
            sim.step(move)
        np.testing.assert_array_equal(compiled.snapshot().physics, plain.snapshot().physics, err_msg=f"step {k}")


# --- the carried arm ---


def test_the_robot_comes_first_in_a_scene(simulate: Callable[..., Simulation]) -> None:
    model = simulate(BOWLS).model
    joints = [model.joint(name) for name in (*robot.ARM_JOINTS, *robot.FINGER_JOINTS)]
    assert [joint.qposadr[0] for joint in joints] == [joint.dofadr[0] for joint in joints] == [*range(9)]
    assert [model.actuator(k).trnid[0] for k in range(9)] == [joint.id for joint in joints]


CARRIED = "e36735ac29316c701c722f5d41b46efc854356d1fdbc46ce611cbd1f02a5262b"
"""Hash of the names and contents that scripts/robosuite_arm.py writes."""


def test_the_arm_is_the_one_of_robosuite() -> None:
    digest = hashlib.sha256()
    for path in sorted(robot.FOLDER.iterdir()):
        digest.update(path.name.encode() + path.read_bytes())
    assert digest.hexdigest() == CARRIED
    base = mujoco.MjModel.from_xml_string(robot.robot_xml()).body("robot0_base").pos
    assert tuple(base[:2]) == robot.BASE_POSITION[:2]


def test_the_arm_is_read_from_any_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / 'R&D "1"'
    folder.symlink_to(robot.FOLDER)
    monkeypatch.setattr(robot, "FOLDER", folder)
    assert mujoco.MjModel.from_xml_string(robot.robot_xml.__wrapped__()).nmesh > 60
