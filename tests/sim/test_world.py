"""Predicates on constructed states: each threshold from both sides."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.asset import TABLE_TOP
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.sim.world import DETENT_DISTANCE, PLACE_DISTANCE
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from tests.sim.conftest import BOWLS, DRAWER, STOVE

Simulate = Callable[..., Simulation]
TOMATO, CABINET = "beefsteak_tomato__1_1", "wooden_cabinet_1"
MICROWAVE = "open_and_close_the_microwave"


def put(sim: Simulation, name: str, position: np.ndarray) -> None:
    """Set an object down at a world position of its origin, upright, without simulating."""
    address = int(sim.model.joint(f"{name}_joint0").qposadr[0])
    sim.data.qpos[address : address + 7] = [*position, 1, 0, 0, 0]
    mujoco.mj_step1(sim.model, sim.data)


def turn(sim: Simulation, joint: str, q: float) -> None:
    sim.data.joint(joint).qpos[0] = q
    mujoco.mj_step1(sim.model, sim.data)


def holds(sim: Simulation, predicate: str, *args: str) -> bool:
    return sim.holds(Atom(predicate, args))


@pytest.mark.parametrize(
    ("joint", "name", "predicate", "true_at", "false_at"),
    [
        ("wooden_cabinet_1_top_level", "wooden_cabinet_1_top_region", "open", -0.1401, -0.14),
        ("wooden_cabinet_1_top_level", "wooden_cabinet_1_top_region", "close", 0.0001, 0.0),
        ("flat_stove_1_button", "flat_stove_1", "turnon", 0.5, 0.4999),
        ("flat_stove_1_button", "flat_stove_1", "turnoff", -0.0001, 0.0),
        ("microwave_1_microjoint", "microwave_1", "open", -1.3001, -1.3),
        ("microwave_1_microjoint", "microwave_1", "close", -0.0049, -0.005),
    ],
)
def test_joints_have_the_published_thresholds(
    simulate: Simulate, joint: str, name: str, predicate: str, true_at: float, false_at: float
) -> None:
    sim = simulate({"w": DRAWER, "f": STOVE, "m": MICROWAVE}[joint[0]])
    turn(sim, joint, true_at)
    assert holds(sim, predicate, name)
    turn(sim, joint, false_at)
    assert not holds(sim, predicate, name)


def test_in_is_a_level_box_with_a_relaxed_floor(simulate: Simulate) -> None:
    """Its half sides are |R·size|: those of the site, turned, as LIBERO computes them."""
    sim = simulate()
    region = f"{CABINET}_top_region"
    turn(sim, f"{CABINET}_top_level", -0.15)
    centre, frame = sim.site_pose(region)
    half = np.abs(frame @ sim.site_half_size(region))
    for place, inside in [
        ((0, 0, 0), True),
        ((0.99, 0, 0), True),
        ((1.01, 0, 0), False),
        ((0, -0.99, 0), True),
        ((0, -1.01, 0), False),
        ((0, 0, 0.99), True),
        ((0, 0, 1.01), False),
    ]:
        put(sim, TOMATO, centre + np.array(place) * half)
        assert holds(sim, "in", TOMATO, region) is inside, place
    for under, inside in [(0.0099, True), (0.0101, False)]:
        put(sim, TOMATO, centre - np.array([0, 0, half[2] + under]))
        assert holds(sim, "in", TOMATO, region) is inside, under
    put(sim, TOMATO, centre)
    turn(sim, f"{CABINET}_top_level", 0.005)
    assert not holds(sim, "in", TOMATO, region), "the region moves with the drawer"
    assert holds(sim, "close", region)
    assert not holds(sim, "open", f"{CABINET}_middle_region")


def test_on_an_object_needs_contact_height_and_distance(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    bowl, _ = sim.body_pose("bowl_left")
    inside = sim.assets["bowl_left"].supports - sim.assets["butter_1"].bottom
    put(sim, "butter_1", bowl + np.array([0, 0, inside - 0.0005]))
    assert holds(sim, "on", "butter_1", "bowl_left")
    assert not holds(sim, "on", "bowl_left", "butter_1"), "the bowl's origin is below the butter's"
    assert not holds(sim, "on", "butter_1", "bowl_mid")
    put(sim, "butter_1", bowl + np.array([0, 0, inside + 0.05]))
    assert not holds(sim, "on", "butter_1", "bowl_left"), "no contact"
    put(sim, "butter_1", bowl + np.array([0.031, 0, inside - 0.0005]))
    assert not holds(sim, "on", "butter_1", "bowl_left"), "3.1 cm from the bowl's centre"


def test_on_a_site_needs_contact_with_its_fixture(simulate: Simulate) -> None:
    sim = simulate(STOVE)
    region, pan = "flat_stove_1_cook_region", "chefmate_8_frypan_1"
    centre, _ = sim.site_pose(region)
    for height in np.linspace(0.0, 0.03, 61):  # lower the pan onto the burner
        put(sim, pan, np.array([centre[0], centre[1], centre[2] + 0.03 - height]))
        if sim.world.touching(pan, "flat_stove_1"):
            break
    assert holds(sim, "on", pan, region)
    put(sim, pan, centre + np.array([0, 0, 0.06]))
    assert not holds(sim, "on", pan, region), "above, without contact"


def test_on_a_region_of_the_table_needs_no_contact(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    region = "kitchen_table_butter_init_region"
    (x1, y1, x2, _), *_ = sim.task.regions[region].ranges
    for x, height, expected in [
        (x1 + 0.001, 0.0, True),
        (x1 - 0.001, 0.0, False),
        (x2 - 0.001, 0.08, True),
        (x2 - 0.001, 0.09, False),
    ]:
        put(sim, "butter_1", np.array([x, y1 + 0.001, TABLE_TOP + height]))
        assert holds(sim, "on", "butter_1", region) is expected, (x, height)


@pytest.mark.parametrize(
    ("atom", "fragment"),
    [
        (Atom("in", (TOMATO, "wooden_cabinet_1_attic_region")), "'wooden_cabinet_1_attic_region'"),
        (Atom("open", (TOMATO,)), "cannot be opened"),
        (Atom("wasopen", ("wooden_cabinet_1_top_region",)), "'wasopen'"),
    ],
)
def test_invalid_atoms_are_errors(simulate: Simulate, atom: Atom, fragment: str) -> None:
    with pytest.raises(MemobenchError, match=fragment):
        simulate().holds(atom)


# --- predicates relative to the start of the execution ---

TASK, BOWL = "open_and_close_the_microwave_a_given_number_of_times", "white_bowl_1"
HOME, IN_PLACE = Atom("handhome", ()), Atom("inplace", (BOWL,))


@pytest.fixture
def sim() -> Simulation:
    sim = Simulation(get_task(TASK))
    sim.reset(20_000)
    return sim


def act(sim: Simulation, steps: int, **values: float) -> None:
    """Take steps of one action, given by its components."""
    action = NO_OP.copy()
    for name, value in values.items():
        action[["x", "y", "z", "rx", "ry", "rz", "grip"].index(name)] = value
    for _ in range(steps):
        sim.step(action)


@pytest.mark.parametrize("move", [{"x": 0.2}, {"rz": 0.5}, {"grip": 1.0}])
def test_moved_rotated_or_closed_hand_is_not_home(sim: Simulation, move: dict[str, float]) -> None:
    start = sim.snapshot()
    for _ in range(20):
        assert sim.holds(HOME), "a resting hand stays home"
        act(sim, 1)
    act(sim, 15, **move)
    assert not sim.holds(HOME)
    sim.restore(start)
    assert sim.holds(HOME)


def arm(sim: Simulation) -> bytes:
    """Return the bits of the arm's state: joints, fingers, velocities, controller."""
    kept = sim.snapshot()
    parts = (sim.data.qpos[:9], sim.data.qvel[:9], kept.goal_position, kept.goal_rotation, kept.gripper)
    return b"".join(part.tobytes() for part in parts)


@pytest.mark.parametrize("move", [{}, {"x": 0.25}, {"y": 0.2, "rz": -0.1}, {"z": 0.2, "grip": 1.0}])
def test_hand_at_rest_near_home_is_restored_exactly(sim: Simulation, move: dict[str, float]) -> None:
    """A policy cannot store information in its pose at home."""
    first = arm(sim)
    act(sim, 3, **move)
    assert (arm(sim) == first) == (not move)
    act(sim, 30)
    assert arm(sim) == first
    assert sim.holds(HOME)


def test_passing_or_distant_hand_is_not_home(sim: Simulation) -> None:
    start, _ = sim.eef_pose()
    act(sim, 1, y=0.3)
    while np.linalg.norm(sim.eef_pose()[0] - start) < 1.2 * DETENT_DISTANCE:
        act(sim, 1, y=0.3)
        assert not sim.holds(HOME)
    act(sim, 30)
    assert not sim.holds(HOME)
    assert sim.data.qvel[0] != 0.0
    while sim.eef_pose()[0][1] > start[1] - DETENT_DISTANCE:
        act(sim, 1, y=-0.5)
        assert not sim.holds(HOME)


def test_published_scenes_have_no_detent() -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"))
    sim.reset(20_000)
    act(sim, 3, x=0.25)
    act(sim, 30)
    assert np.linalg.norm(sim.eef_pose()[0] - sim.home[0]) > 0.005


def test_in_place_tolerance(sim: Simulation) -> None:
    joint = sim.data.joint(f"{BOWL}_joint0")
    state = sim.state()
    for shift, expected in ((0.9 * PLACE_DISTANCE, True), (1.1 * PLACE_DISTANCE, False)):
        sim.set_state(state)
        joint.qpos[1] += shift
        sim.set_state(sim.state())
        assert sim.holds(IN_PLACE) == expected
    sim.begin_execution()
    assert sim.holds(IN_PLACE)
    assert sim.holds(HOME)
