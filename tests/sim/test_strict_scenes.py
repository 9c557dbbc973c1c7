"""Strict scenes: nearly closed joints return to their start; published scenes are unchanged."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.progress import AS_BEGUN

DRAWER = ("check_the_top_drawer_a_given_number_of_times", "wooden_cabinet_1_top_region")
DOOR = ("open_and_close_the_microwave_a_given_number_of_times", "microwave_1")
KNOB = ("turn_the_stove_on_and_off_a_given_number_of_times", "flat_stove_1")
AT_REST = 1e-9
"""Distance from the start at which a joint has come to rest, m or rad."""


def left_at(name: str, thing: str, q: float, steps: int = 20) -> tuple[float, float]:
    """Return where a joint was after the reset, and where it is some steps after it was left at ``q``."""
    sim = Simulation(get_task(name))
    sim.reset(20_000)
    articulation, start = sim.world.articulation(thing)
    sim.data.joint(articulation.joint).qpos[0] = q
    sim.data.joint(articulation.joint).qvel[0] = 0.0
    mujoco.mj_step1(sim.model, sim.data)
    for _ in range(steps):
        sim.step(NO_OP)
    return start, sim.world.articulation(thing)[1]


@pytest.mark.parametrize(
    ("place", "q"),
    [
        pytest.param(DRAWER, 0.0001, id="drawer that just counts as shut"),
        pytest.param(DOOR, -0.0049, id="door that just counts as shut"),
        pytest.param(KNOB, 0.03, id="knob a little on"),
    ],
)
def test_nearly_closed_joints_return_to_their_start(place: tuple[str, str], q: float) -> None:
    start, now = left_at(*place, q)
    assert abs(now - start) < AT_REST


@pytest.mark.parametrize(("place", "q"), [(DRAWER, -0.03), (DOOR, -0.2), (KNOB, 0.32)])
def test_open_joints_stay(place: tuple[str, str], q: float) -> None:
    assert abs(left_at(*place, q)[1] - q) < 1e-4


def test_strict_joints_only_have_detents() -> None:
    for name in task_names("temporal", suite="strict")[::3]:
        strict = get_scene(get_task(name))
        joints = [joint.joint for asset in strict.assets.values() for joint in asset.articulations.values()]
        tendons = [strict.model.tendon(k).name for k in range(strict.model.ntendon)]
        assert sorted(tendons) == sorted(f"{joint}_detent" for joint in joints)
        published = get_scene(get_task(str(get_task(name).derived_from))).model
        assert not published.ntendon
        drawers = [published.joint(joint).range.tolist() for joint in joints if joint.endswith("_level")]
        assert all(limits == [-0.16, 0.01] for limits in drawers)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in task_names("temporal", suite="strict") if "given_number" in name])
def test_no_disturbed_object_returns_by_itself_during_a_rest(name: str) -> None:
    """A rest of 40 steps in a scene that is as begun in its last step alone would follow an event without a hold."""
    sim, rng, returns = Simulation(get_task(name)), np.random.default_rng(0), []
    sim.reset(20_000)
    begun = sim.snapshot()
    for thing in get_task(name).objects:
        address = int(sim.model.joint(int(sim.model.body(thing).jntadr[0])).qposadr[0])
        for trial in range(40):
            sim.restore(begun)
            pose = sim.data.qpos[address : address + 7]
            angle = rng.uniform(0.02, 0.9) if trial % 2 else 0.0  # tilted, or dropped
            axis = rng.normal(size=3) * (1.0, 1.0, 0.1)
            turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
            pose[3:] = (turn * Rotation.from_quat(pose[3:], scalar_first=True)).as_quat(scalar_first=True)
            pose[2] += 0.06 * np.sin(angle) if trial % 2 else rng.uniform(0.002, 0.15)
            mujoco.mj_step1(sim.model, sim.data)
            for step in range(1, 100):
                sim.step(NO_OP)
                if sim.holds(AS_BEGUN):
                    returns.append(step)
                    break
    assert returns
    assert max(returns) < 20
