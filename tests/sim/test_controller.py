"""The arm moves as the published stack's does, and is driven by the same torques."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim import robot
from lerobot_memobench.sim.controller import OSCController, orientation_error, rotation_matrix
from lerobot_memobench.sim.scene import SUBSTEPS
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS

FIGURES = Path(__file__).parent / "data" / "osc_trajectory.npz"
"""300 actions and, before each of them, end effector (position m, quaternion xyzw) and joints (rad) of the published
stack's arm, which had been reset and stepped ten times without moving."""


class Arm:
    """The arm alone, stepped as `Simulation.step` steps it."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model, self.data = model, mujoco.MjData(model)
        self.controller = OSCController(model)
        joints = [int(model.joint(name).qposadr[0]) for name in robot.ARM_JOINTS]
        fingers = [int(model.joint(name).qposadr[0]) for name in robot.FINGER_JOINTS]
        self.data.qpos[joints] = robot.ARM_START
        self.data.qpos[fingers] = robot.GRIPPER_START
        mujoco.mj_step1(model, self.data)
        self.controller.reset(self.data)

    def step(self, action: np.ndarray, watch: Any = None) -> None:
        self.controller.set_goal(self.data, action)
        for _ in range(SUBSTEPS):
            if watch is not None:
                watch()
            self.controller.apply(self.data, float(action[6]))
            mujoco.mj_step2(self.model, self.data)
            mujoco.mj_step1(self.model, self.data)


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


class BindingShim:
    """The few parts of robosuite's simulator binding that its controller asks for."""

    def __init__(self, arm: Arm) -> None:
        model, data = arm.model, arm.data
        self.model = SimpleNamespace(
            nv=model.nv,
            _model=model,
            site_name2id=lambda name: model.site(name).id,
            opt=model.opt,
        )
        self._data = data
        self.data = self
        self.forward = lambda: None

    def __getattr__(self, name: str) -> Any:
        data = self.__dict__["_data"]
        if name == "qM":
            return data.qM
        return getattr(data, name)

    def get_site_jacp(self, name: str) -> np.ndarray:
        return self._jacobian(name)[0].ravel()

    def get_site_jacr(self, name: str) -> np.ndarray:
        return self._jacobian(name)[1].ravel()

    def get_site_xvelp(self, name: str) -> np.ndarray:
        return self._jacobian(name)[0] @ self._data.qvel

    def get_site_xvelr(self, name: str) -> np.ndarray:
        return self._jacobian(name)[1] @ self._data.qvel

    def _jacobian(self, name: str) -> np.ndarray:
        jacobian = np.zeros((2, 3, self.model.nv))
        mujoco.mj_jacSite(self.model._model, self._data, jacobian[0], jacobian[1], self.model.site_name2id(name))
        return jacobian


@pytest.mark.filterwarnings("ignore")
def test_torques_equal_robosuites_controller(arm_model: mujoco.MjModel) -> None:
    from robosuite.controllers import controller_factory, load_controller_config

    arm = Arm(arm_model)
    joints = [arm_model.joint(name) for name in robot.ARM_JOINTS]
    actuators = [arm_model.actuator(name).id for name in robot.ARM_ACTUATORS]
    settings = load_controller_config(default_controller="OSC_POSE")
    settings.update(
        robot_name="Panda",
        sim=BindingShim(arm),
        eef_name=robot.GRIP_SITE,
        eef_rot_offset=np.array([0.0, 0.0, 0.0, 1.0]),
        joint_indexes={
            "joints": [joint.id for joint in joints],
            "qpos": [int(joint.qposadr[0]) for joint in joints],
            "qvel": [int(joint.dofadr[0]) for joint in joints],
        },
        actuator_range=(arm_model.actuator_ctrlrange[actuators, 0], arm_model.actuator_ctrlrange[actuators, 1]),
        policy_freq=20,
        ndim=7,
    )
    theirs = controller_factory("OSC_POSE", settings)
    theirs.update_initial_joints(np.array(robot.ARM_START))
    worst = 0.0

    def compare() -> None:
        nonlocal worst
        theirs.new_update = True
        # robosuite asks for the torques before clipping, gravity compensation included.
        worst = max(worst, float(np.abs(theirs.run_controller() - arm.controller.torques(arm.data)).max()))

    for action in [NO_OP] * STABILISATION_STEPS + list(np.load(FIGURES)["actions"]):
        theirs.update(force=True)
        theirs.set_goal(action[:6])
        arm.step(action, compare)
    assert worst < 1e-8, f"torques differ by up to {worst:.2g} Nm"


def test_gripper_moves_at_its_speed_and_stops(arm_model: mujoco.MjModel) -> None:
    arm = Arm(arm_model)
    for _ in range(2):
        arm.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    np.testing.assert_allclose(arm.controller.gripper, [-0.5, 0.5])
    for _ in range(3):
        arm.step(np.array([0, 0, 0, 0, 0, 0, 1.0]))
    np.testing.assert_array_equal(arm.controller.gripper, [-1.0, 1.0])
    arm.step(np.array([0, 0, 0, 0, 0, 0, 0.0]))
    np.testing.assert_array_equal(arm.controller.gripper, [-1.0, 1.0])


def test_zero_rotation_keeps_the_former_goal(arm_model: mujoco.MjModel) -> None:
    arm = Arm(arm_model)
    arm.step(np.array([0, 0, 0, 0, 0, 0.4, -1.0]))
    turned = arm.controller.goal_rotation.copy()
    arm.step(NO_OP)
    np.testing.assert_array_equal(arm.controller.goal_rotation, turned)


def test_actions_beyond_one_are_clipped(arm_model: mujoco.MjModel) -> None:
    arm = Arm(arm_model)
    arm.controller.set_goal(arm.data, np.array([9.0, -9.0, 0, 0, 0, 0, 0]))
    moved = arm.controller.goal_position - arm.data.site_xpos[arm_model.site(robot.GRIP_SITE).id]
    np.testing.assert_allclose(moved, [0.05, -0.05, 0.0], atol=1e-12)


def test_rotation_vectors() -> None:
    quarter = rotation_matrix(np.array([0.0, 0.0, np.pi / 2]))
    np.testing.assert_allclose(quarter @ [1, 0, 0], [0, 1, 0], atol=1e-6)
    np.testing.assert_array_equal(rotation_matrix(np.zeros(3)), np.eye(3))
    small = np.array([0.001, -0.002, 0.0015])
    np.testing.assert_allclose(orientation_error(rotation_matrix(small), np.eye(3)), small, atol=1e-6)
