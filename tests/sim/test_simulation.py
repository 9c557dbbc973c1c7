"""Determinism, states and snapshots, what is asked of a simulation, and what it refuses."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.simulation import NO_OP, Simulation, axis_angle
from lerobot_memobench.tasks.catalogue import get_task, task_names

Simulate = Callable[..., Simulation]
STEPS = 100
CATALOGUE = Path(__file__).parents[3] / "shared" / "spec" / "catalogue.json"

_PROGRAM = """
import json, sys
import numpy as np
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
for name in sys.argv[2:]:
    sim = Simulation(get_task(name))
    sim.reset(int(sys.argv[1]))
    hashes = [sim.scene_hash()]
    rng = np.random.default_rng(3)
    for _ in range({steps}):
        sim.step(rng.uniform(-1, 1, 7))
    print(json.dumps([name, hashes[0], sim.scene_hash()]))
"""


def walk(sim: Simulation, steps: int = STEPS) -> list[str]:
    """Return the hash of the present scene and that after some steps of given random actions."""
    first = sim.scene_hash()
    rng = np.random.default_rng(3)
    for _ in range(steps):
        sim.step(rng.uniform(-1, 1, 7))
    return [first, sim.scene_hash()]


def in_fresh_process(names: list[str], seed: int, steps: int = STEPS) -> dict[str, list[str]]:
    program = _PROGRAM.replace("{steps}", str(steps))
    done = subprocess.run(
        [sys.executable, "-c", program, str(seed), *names], capture_output=True, text=True, check=True, timeout=600
    )
    return {name: hashes for name, *hashes in map(json.loads, done.stdout.splitlines())}


def check_against_fresh_process(names: list[str], steps: int) -> None:
    fresh = in_fresh_process(names, seed=7, steps=steps)
    for name in names:
        sim = Simulation(get_task(name))
        for seed in (11, 9):
            sim.reset(seed)
            walk(sim, 5)
        sim.reset(7)
        assert walk(sim, steps) == fresh[name], name


@pytest.mark.parametrize("task", ["check_all_three_drawers_of_the_cabinet", "open_and_close_the_microwave"])
def test_sensors_are_off_and_nothing_else_follows(task: str) -> None:
    """Nobody reads robosuite's sensors; with them the scene goes the same way, to the last bit."""
    without, with_sensors = Simulation(get_task(task)), Simulation(get_task(task))
    off = mujoco.mjtDisableBit.mjDSBL_SENSOR.value
    assert without.model.opt.disableflags & off
    with_sensors.model.opt.disableflags &= ~off
    for sim in (without, with_sensors):
        sim.reset(7)
        walk(sim)
    assert not without.data.sensordata.any()
    assert with_sensors.data.sensordata.any()
    for name in ("physics", "goal_position", "goal_rotation", "gripper"):
        np.testing.assert_array_equal(getattr(without.snapshot(), name), getattr(with_sensors.snapshot(), name))


def test_reset_after_other_seeds_equals_a_fresh_process() -> None:
    names = ["put_the_tomato_into_the_top_drawer_of_the_cabinet", "open_and_close_the_microwave"]
    check_against_fresh_process(names, STEPS)


@pytest.mark.slow
def test_reset_after_other_seeds_equals_a_fresh_process_for_all_tasks() -> None:
    check_against_fresh_process(task_names(), STEPS)


def test_seeds_differ(simulate: Simulate) -> None:
    assert len({simulate(seed=seed).scene_hash() for seed in range(5)}) == 5


def test_two_simulations_of_a_task_do_not_touch_each_other(simulate: Simulate) -> None:
    one, alone = simulate(seed=7), simulate(seed=7)
    expected = walk(alone, 20)
    other = simulate(seed=8)  # moves the fixtures of its own model
    rng = np.random.default_rng(3)
    assert one.scene_hash() == expected[0]
    for _ in range(20):
        one.step(rng.uniform(-1, 1, 7))
        other.step(NO_OP)
    assert one.scene_hash() == expected[1]


def test_snapshot_and_restore_are_exact(simulate: Simulate) -> None:
    sim = simulate()
    walk(sim, 15)
    snapshot, before = sim.snapshot(), sim.scene_hash()
    first = walk(sim, 25)
    sim.restore(snapshot)
    assert sim.scene_hash() == before
    assert walk(sim, 25) == first


def test_state_goes_out_and_in(simulate: Simulate) -> None:
    sim = simulate()
    walk(sim, 10)
    state, poses = sim.state(), sim.fixture_poses()
    tomato = sim.body_pose("beefsteak_tomato__1_1")[0]
    proprio = sim.proprio()
    other = simulate(seed=12)
    other.set_state(state, poses)
    np.testing.assert_array_equal(other.state(), state)
    np.testing.assert_array_equal(other.body_pose("beefsteak_tomato__1_1")[0], tomato)
    np.testing.assert_array_equal(other.proprio(), proprio)
    assert other.scene_hash() == sim.scene_hash()


def test_stepping_twice_from_a_set_state_is_the_same(simulate: Simulate) -> None:
    sim = simulate()
    state = sim.state()
    ends = []
    for _ in range(2):
        sim.reset(7)
        sim.set_state(state)
        ends.append(walk(sim, 10)[1])
    assert ends[0] == ends[1]


def test_proprioception(simulate: Simulate) -> None:
    sim = simulate()
    proprio = sim.proprio()
    assert proprio.shape == (8,)
    assert proprio.dtype == np.float32
    np.testing.assert_allclose(proprio[:3], sim.eef_pose()[0], atol=1e-6)
    assert proprio[6] > 0 > proprio[7]
    np.testing.assert_allclose(sim.gripper_opening(), proprio[6] - proprio[7], atol=1e-6)


def test_axis_angle_keeps_the_quaternions_sign() -> None:
    quarter = np.array([np.cos(np.pi / 4), np.sin(np.pi / 4), 0, 0])
    np.testing.assert_allclose(axis_angle(quarter), [np.pi / 2, 0, 0])
    np.testing.assert_allclose(axis_angle(-quarter), [-3 * np.pi / 2, 0, 0])
    np.testing.assert_array_equal(axis_angle(np.array([1.0, 0, 0, 0])), np.zeros(3))


@pytest.mark.parametrize("action", [np.zeros(6), np.zeros((1, 7)), np.zeros(8)])
def test_action_of_another_shape(simulate: Simulate, action: np.ndarray) -> None:
    with pytest.raises(MemobenchError, match=r"an action has shape .*; expected \(7,\)"):
        simulate().step(action)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_action_that_is_not_finite_changes_nothing(simulate: Simulate, value: float) -> None:
    sim = simulate()
    before = sim.scene_hash()
    with pytest.raises(MemobenchError, match="not finite"):
        sim.step(np.array([0, 0, value, 0, 0, 0, 0]))
    assert sim.scene_hash() == before


def test_state_of_another_task(simulate: Simulate) -> None:
    with pytest.raises(MemobenchError, match=r"has shape \(5,\); expected"):
        simulate().set_state(np.zeros(5))


@pytest.mark.slow
def test_state_sizes_are_the_published_ones() -> None:
    if not CATALOGUE.exists():
        pytest.skip("the published catalogue is not here")
    published = {task["name"]: task["state_dim"] for task in json.loads(CATALOGUE.read_text())}
    assert sorted(published) == sorted(task_names())
    found = {name: Simulation(get_task(name)).state_dim for name in task_names()}
    assert found == published


def test_state_size_is_time_positions_velocities(simulate: Simulate) -> None:
    sim = simulate()
    assert sim.state().shape == (sim.state_dim,) == (1 + sim.model.nq + sim.model.nv,)
    assert sim.state().dtype == np.float64
