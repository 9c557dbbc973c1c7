"""The arm moves as in the published stack; the compiled torques equal NumPy's."""

from __future__ import annotations

import hashlib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim import robot
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS

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


# --- the carried arm ---


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
