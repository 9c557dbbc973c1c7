"""Strict scenes: nearly closed joints return to their start, rolling objects stop; published scenes are unchanged."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.scene import scene_spec
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names

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
        strict, assets = scene_spec(get_task(name))
        joints = [articulation.joint for asset in assets.values() for articulation in asset.articulations.values()]
        assert sorted(tendon.name for tendon in strict.tendons) == sorted(f"{joint}_detent" for joint in joints)
        published, _ = scene_spec(get_task(str(get_task(name).derived_from)))
        assert not published.tendons
        assert all(tuple(joint.range) == (-0.16, 0.01) for joint in published.joints if joint.name.endswith("_level"))


# --- rolling friction ---

PUBLISHED = "put_the_artichoke_into_the_top_drawer_and_the_chestnut_into_the_middle_drawer"
STRICT = "find_the_artichoke_or_the_chestnut_hidden_in_two_of_the_drawers"
SPEED = 0.15


def rolled(task: str, name: str) -> tuple[float, float]:
    """Lay a thing on its side, give it a push, and return how far it is after a second, m, and its speed then, m/s."""
    sim = Simulation(get_task(task))
    sim.reset(20_000)
    joint = sim.data.joint(f"{name}_joint0")
    lying = Rotation.from_euler("y", 90, degrees=True).as_quat(scalar_first=True)
    joint.qpos[:] = [-0.1, 0.25, TABLE_TOP + sim.assets[name].radius + 0.001, *lying]
    joint.qvel[:] = 0.0
    for _ in range(4):
        sim.step(NO_OP)
    joint.qvel[1] = SPEED
    start = joint.qpos[:2].copy()
    for _ in range(20):
        sim.step(NO_OP)
    return float(np.linalg.norm(joint.qpos[:2] - start)), float(np.linalg.norm(joint.qvel[:3]))


def test_rolling_objects_stop_in_strict_scenes() -> None:
    far, fast = rolled(PUBLISHED, "artichoke_1")
    near, slow = rolled(STRICT, "artichoke_1")
    assert fast > 0.02, "in the published scene it still rolls"
    assert slow < 0.002
    assert near < 0.3 * far
