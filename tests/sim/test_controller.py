"""The arm moves as in the published stack, with equal torques, compiled or not."""

from __future__ import annotations

import hashlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numba.core import caching

import lerobot_memobench.sim
from lerobot_memobench.envs.episode import PROMPT, Episode
from lerobot_memobench.sim import controller as control
from lerobot_memobench.sim import osc_kernel, robot
from lerobot_memobench.sim.controller import CompiledController, OSCController
from lerobot_memobench.sim.scene import SUBSTEPS
from lerobot_memobench.sim.simulation import NO_OP, STABILISATION_STEPS, Simulation
from lerobot_memobench.tasks.catalogue import get_task

FIGURES = Path(__file__).parent / "data" / "osc_trajectory.npz"
"""300 actions and, before each, end effector (position m, quaternion xyzw) and joints (rad) of the published stack's
arm after a reset and ten steps without motion."""


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


# --- compiled steps equal numpy's bit for bit ---

TASKS = (
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    "open_and_close_the_microwave",
    "put_the_butter_into_the_bowl_from_the_prompt_video",
)
MOVES = np.random.default_rng(0).uniform(-1, 1, (20, 7))
MOVES[::4, 3:6] = 0.0  # keeps the former orientation


def by_numpy(sim: Simulation) -> Simulation:
    """Give a simulation the numpy controller."""
    sim._controller = OSCController(sim.model)
    return sim


def simulation(task: str = TASKS[0]) -> Simulation:
    sim = Simulation(get_task(task))
    assert isinstance(sim._controller, CompiledController)
    return sim


def bits(sim: Simulation) -> bytes:
    parts = sim.state(), sim.data.ctrl, sim.data.qacc_warmstart, sim.data.qfrc_bias, sim._controller.gripper
    return b"".join(part.tobytes() for part in parts)


def moved(sim: Simulation) -> bytes:
    """Reset, take `MOVES`, and return the bits of where that leads."""
    sim.reset(7)
    for move in MOVES:
        sim.step(move)
    return bits(sim)


@pytest.fixture
def undecided(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reset the decision of the process about the compiled controller."""
    monkeypatch.setattr(control._Process, "agrees", None)


@pytest.mark.parametrize("task", [TASKS[2], *(pytest.param(task, marks=pytest.mark.slow) for task in TASKS[:2])])
def test_episodes_are_equal_bit_for_bit(task: str) -> None:
    """The expert reaches, grasps and carries; every fourth step is random."""
    compiled, plain = Episode(get_task(task)), Episode(get_task(task))
    assert isinstance(compiled.sim._controller, CompiledController)
    by_numpy(plain.sim)
    for episode in (compiled, plain):
        episode.reset(7)
    for k in range(160):
        if compiled.done:
            break
        action = np.zeros(7, np.float32) if compiled.phase == PROMPT else compiled.expert_action()
        if k % 4 == 3 and compiled.phase != PROMPT:
            action = MOVES[k % len(MOVES)]
        compiled.step(action), plain.step(action)
        assert bits(compiled.sim) == bits(plain.sim), f"step {k}"
    assert control._Process.agrees, "no step was compared"
    assert k > 50


def test_a_snapshot_continues_equally_in_both() -> None:
    sims = simulation(), by_numpy(simulation())
    moved(sims[0]), moved(sims[1])
    snapshot = sims[0].snapshot()
    for sim in sims:
        sim.restore(snapshot)
        sim.step(NO_OP)
    assert bits(sims[0]) == bits(sims[1])


def test_threads_do_not_disturb_each_other() -> None:
    expected = moved(simulation())
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(moved(simulation()))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [expected] * 3


# --- fall back to numpy ---


def without_a_place_for_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, osc_kernel.__name__)
    monkeypatch.delattr(lerobot_memobench.sim, "osc_kernel")
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])


def without_a_function_of_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    class Library:
        mj_step1 = mj_step2 = mj_jacSite = None

    monkeypatch.setattr(osc_kernel.ctypes, "CDLL", lambda _: Library())
    monkeypatch.setattr(osc_kernel.ctypes, "cast", lambda *_: osc_kernel.ctypes.c_void_p(1))


def with_a_newer_mujoco(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its functions may have other signatures and must not be looked up."""
    monkeypatch.setattr(control, "MUJOCO", (control.NEWEST_MUJOCO[0], control.NEWEST_MUJOCO[1] + 1))
    monkeypatch.setattr(osc_kernel, "functions", lambda: pytest.fail("called by address"))


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize("lacking", [without_a_place_for_the_cache, without_a_function_of_mujoco, with_a_newer_mujoco])
def test_falls_back_to_numpy(
    lacking: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    expected = moved(simulation())
    monkeypatch.setattr(control._Process, "agrees", None)
    with monkeypatch.context() as patch:
        lacking(patch)
        sim = Simulation(get_task(TASKS[0]))
        assert type(sim._controller) is OSCController
        assert moved(sim) == expected
    assert capfd.readouterr() == ("", "")
    assert type(Simulation(get_task(TASKS[0]))._controller) is OSCController, "decided once per process"


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize("fault", ["fails", "differs"])
def test_the_first_step_decides(fault: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """The step is numpy's if the compiled call fails or returns other numbers."""
    expected = moved(by_numpy(simulation()))
    calls: list[int] = []

    def other_numbers(*arguments: Any) -> None:
        calls.append(1)
        if fault == "fails":
            raise OSError("the cache cannot be read")
        advance(*arguments)
        arguments[8].qpos[0] = np.nextafter(arguments[8].qpos[0], 9)

    advance = osc_kernel.advance
    monkeypatch.setattr(osc_kernel, "advance", other_numbers)
    sim = simulation()
    assert moved(sim) == expected
    assert control._Process.agrees is False
    assert len(calls) == 1
    assert capfd.readouterr() == ("", "")


def arm_with(memory: int) -> tuple[mujoco.MjData, CompiledController]:
    """Return an arm with limited simulation memory, bytes."""
    spec = mujoco.MjSpec.from_string(robot.robot_xml())
    spec.nconmax, spec.njmax, spec.memory = -1, -1, memory
    model = spec.compile()
    data, controller = mujoco.MjData(model), CompiledController(model)
    mujoco.mj_step1(model, data)
    controller.reset(data)
    return data, controller


@pytest.mark.parametrize(("times", "ways"), [(3.0, ["compiled"]), (1.5, ["numpy"])])
def test_scarce_memory_uses_numpy(times: float, ways: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Out of memory, a call by address ends the process; the bindings used by numpy raise instead."""
    data, controller = arm_with(2**20)
    OSCController.advance(controller, data, -1.0, 1)
    data, controller = arm_with(int(times * data.maxuse_arena))
    OSCController.advance(controller, data, -1.0, 1)
    taken: list[str] = []
    monkeypatch.setattr(control._Process, "agrees", True)
    monkeypatch.setattr(CompiledController, "_advance", lambda *_: taken.append("compiled"))
    monkeypatch.setattr(OSCController, "advance", lambda *_: taken.append("numpy"))
    controller.advance(data, -1.0, 1)
    assert taken == ways


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
