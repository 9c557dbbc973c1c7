"""What is compiled moves the scene as numpy does, bit for bit, and steps back where it cannot."""

from __future__ import annotations

import copy
import subprocess
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
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task

TASKS = (
    "put_the_tomato_into_the_top_drawer_of_the_cabinet",
    "open_and_close_the_microwave",
    "put_the_butter_into_the_bowl_from_the_prompt_video",
    "turn_on_the_stove_and_turn_it_off",
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
    """Let the process not know yet whether what is compiled can be used."""
    monkeypatch.setattr(control._Process, "agrees", None)


@pytest.mark.parametrize("task", TASKS)
def test_episodes_are_equal_bit_for_bit(task: str) -> None:
    """The expert reaches, grasps and carries; every fourth step is a random one."""
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
    assert control._Process.agrees, "nothing was compared"
    assert k > 50


def test_a_snapshot_goes_on_the_same_in_either() -> None:
    sims = simulation(), by_numpy(simulation())
    moved(sims[0]), moved(sims[1])
    snapshot = sims[0].snapshot()
    for sim in sims:
        sim.restore(snapshot)
        sim.step(NO_OP)
    assert bits(sims[0]) == bits(sims[1])


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_numbers_that_are_none_are_treated_alike(
    broken: float, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a file
    sims = simulation(), by_numpy(simulation())
    for sim in sims:
        sim.reset(7)
        sim._controller.set_goal(sim.data, MOVES[0])
        sim._controller.goal_position = np.array([broken, 0.0, 1.0])
        sim._controller.advance(sim.data, 1.0, 3)
    assert bits(sims[0]) == bits(sims[1])
    assert sims[0].data.warning.number.sum() > 0


def test_copied_data_moves_by_itself() -> None:
    """A controller holds no address: it moves the data that it is given."""
    sim = simulation()
    before = moved(sim)
    other, controller = copy.copy(sim.data), copy.deepcopy(sim._controller)
    controller.advance(other, 1.0, 5)
    assert bits(sim) == before
    sim._controller.advance(sim.data, 1.0, 5)
    np.testing.assert_array_equal(other.qpos, sim.data.qpos)
    np.testing.assert_array_equal(other.ctrl, sim.data.ctrl)


def test_threads_do_not_disturb_each_other() -> None:
    expected = moved(simulation())
    found: list[bytes] = []
    threads = [threading.Thread(target=lambda: found.append(moved(simulation()))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [expected] * 3


_WORKERS = """
import hashlib, multiprocessing, sys
from lerobot_memobench.sim import controller as control
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

def moved(_):
    sim = Simulation(get_task(sys.argv[1]))
    sim.reset(7)
    sim.step([0.3, -0.4, -0.5, 0.1, 0.2, 0.3, 1.0])
    return hashlib.sha256(sim.state().tobytes()).hexdigest(), control._Process.agrees

if __name__ == "__main__":
    here = moved(0)
    for method in ("fork", "spawn"):
        with multiprocessing.get_context(method).Pool(2) as pool:
            assert pool.map(moved, range(2)) == [here, here], method
    assert here[1]
"""


def test_workers_move_as_their_parent(tmp_path: Path) -> None:
    script = tmp_path / "workers.py"
    script.write_text(_WORKERS)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", str(script), TASKS[0]], capture_output=True, text=True, timeout=300
    )
    assert (done.returncode, done.stderr) == (0, "")


# --- where it cannot be used ---


def forget_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the compiled module be imported anew."""
    monkeypatch.delitem(sys.modules, osc_kernel.__name__)
    monkeypatch.delattr(lerobot_memobench.sim, "osc_kernel")


def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_kernel(monkeypatch)
    monkeypatch.setitem(sys.modules, "numba", None)


def without_a_place_for_the_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    forget_kernel(monkeypatch)
    monkeypatch.setattr(caching.CompileResultCacheImpl, "_locator_classes", [])


def with_another_blas(monkeypatch: pytest.MonkeyPatch) -> None:
    class Library:
        mj_step1 = mj_step2 = mj_jacSite = mj_fullM = None

    monkeypatch.setattr(osc_kernel.ctypes, "CDLL", lambda _: Library())
    monkeypatch.setattr(osc_kernel.ctypes, "cast", lambda *_: osc_kernel.ctypes.c_void_p(1))


def without_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(osc_kernel, "functions", lambda: (_ for _ in ()).throw(OSError("no such library")))


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize(
    "lacking", [without_numba, without_a_place_for_the_cache, with_another_blas, without_addresses]
)
def test_numpy_steps_in(
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
    assert type(Simulation(get_task(TASKS[0]))._controller) is OSCController, "asked once per process"


@pytest.mark.usefixtures("undecided")
@pytest.mark.parametrize("fault", ["fails", "differs"])
def test_the_first_step_decides(fault: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """Whether the call fails (numba compiles or loads in it) or gives other numbers, the step is numpy's."""
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
    """Return an arm whose simulation may use so many bytes."""
    spec = robot.robot_spec()
    spec.nconmax, spec.njmax, spec.memory = -1, -1, memory
    model = spec.compile()
    data, controller = mujoco.MjData(model), CompiledController(model)
    mujoco.mj_step1(model, data)
    controller.reset(data)
    return data, controller


@pytest.mark.parametrize(("times", "ways"), [(3.0, ["compiled"]), (1.5, ["numpy"])])
def test_scarce_memory_is_left_to_what_raises(times: float, ways: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo ends the process for want of memory; its bindings, which the numpy controller calls, raise instead."""
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
