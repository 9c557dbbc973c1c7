"""Predicates on states made by hand: each threshold from both sides."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom

Simulate = Callable[..., Simulation]
TOMATO, CABINET = "beefsteak_tomato__1_1", "wooden_cabinet_1"
STOVE = "turn_on_the_stove_and_turn_it_off"
BOWLS = "put_the_butter_into_the_bowl_from_the_prompt_video"
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
        ("wooden_cabinet_1_bottom_level", "wooden_cabinet_1_bottom_region", "open", -0.16, -0.13),
        ("flat_stove_1_button", "flat_stove_1", "turnon", 0.5, 0.4999),
        ("flat_stove_1_button", "flat_stove_1", "turnoff", -0.0001, 0.0),
        ("microwave_1_microjoint", "microwave_1", "open", -1.3001, -1.3),
        ("microwave_1_microjoint", "microwave_1", "close", -0.0049, -0.005),
    ],
)
def test_joints_have_the_published_thresholds(
    simulate: Simulate, joint: str, name: str, predicate: str, true_at: float, false_at: float
) -> None:
    sim = simulate({"w": "put_the_tomato_into_the_top_drawer_of_the_cabinet", "f": STOVE, "m": MICROWAVE}[joint[0]])
    articulation, _ = sim.world.articulation(name)
    turn(sim, articulation.joint, true_at)
    assert holds(sim, predicate, name)
    turn(sim, articulation.joint, false_at)
    assert not holds(sim, predicate, name)


def test_drawers_are_told_apart(simulate: Simulate) -> None:
    sim = simulate()
    turn(sim, f"{CABINET}_middle_level", -0.15)
    assert holds(sim, "open", f"{CABINET}_middle_region")
    assert not holds(sim, "open", f"{CABINET}_top_region")
    assert holds(sim, "close", f"{CABINET}_top_region")


def test_in_is_the_site_box_with_a_relaxed_floor(simulate: Simulate) -> None:
    sim = simulate()
    region = f"{CABINET}_top_region"
    turn(sim, f"{CABINET}_top_level", -0.15)
    centre, frame = sim.site_pose(region)
    half = sim.site_half_size(region)
    for local, inside in [
        ((0, 0, 0), True),
        ((0.99, 0, 0), True),
        ((1.01, 0, 0), False),
        ((0, -0.99, 0), True),
        ((0, -1.01, 0), False),
        ((0, 0, 0.99), True),
        ((0, 0, 1.01), False),
    ]:
        put(sim, TOMATO, centre + frame @ (np.array(local) * half))
        assert holds(sim, "in", TOMATO, region) is inside, local
    for under, inside in [(0.0099, True), (0.0101, False)]:
        put(sim, TOMATO, centre - frame @ np.array([0, 0, half[2] + under]))
        assert holds(sim, "in", TOMATO, region) is inside, under


def test_in_moves_with_the_drawer(simulate: Simulate) -> None:
    sim = simulate()
    region = f"{CABINET}_top_region"
    turn(sim, f"{CABINET}_top_level", -0.15)
    put(sim, TOMATO, sim.site_pose(region)[0])
    assert holds(sim, "in", TOMATO, region)
    turn(sim, f"{CABINET}_top_level", 0.005)
    assert not holds(sim, "in", TOMATO, region)


def test_on_an_object_wants_contact_height_and_nearness(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    bowl, _ = sim.body_pose("bowl_left")
    inside = sim.assets["bowl_left"].supports - sim.assets["butter_1"].bottom
    put(sim, "butter_1", bowl + np.array([0, 0, inside - 0.0005]))
    assert holds(sim, "on", "butter_1", "bowl_left")
    assert not holds(sim, "on", "bowl_left", "butter_1"), "the bowl's origin is below the butter's"
    assert not holds(sim, "on", "butter_1", "bowl_mid")
    put(sim, "butter_1", bowl + np.array([0, 0, inside + 0.01]))
    assert not holds(sim, "on", "butter_1", "bowl_left"), "no contact"
    put(sim, "butter_1", bowl + np.array([0.031, 0, inside - 0.0005]))
    assert not holds(sim, "on", "butter_1", "bowl_left"), "3.1 cm beside the bowl's middle"


def test_on_a_site_wants_contact_with_its_fixture(simulate: Simulate) -> None:
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


def test_on_a_region_of_the_table(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    region = "kitchen_table_butter_init_region"
    low = sim.assets["butter_1"].bottom
    put(sim, "butter_1", np.array([-0.10, 0.0, TABLE_TOP - low - 0.0005]))
    assert holds(sim, "on", "butter_1", region)
    put(sim, "butter_1", np.array([-0.16, 0.0, TABLE_TOP - low - 0.0005]))
    assert not holds(sim, "on", "butter_1", region), "1 cm outside"
    put(sim, "butter_1", np.array([-0.10, 0.0, TABLE_TOP - low + 0.02]))
    assert not holds(sim, "on", "butter_1", region), "2 cm above the table"


@pytest.mark.parametrize(
    ("atom", "words"),
    [
        (Atom("in", ("no_such_thing", "wooden_cabinet_1_top_region")), "no object or fixture 'no_such_thing'"),
        (Atom("in", (TOMATO, "wooden_cabinet_1_attic_region")), "no region 'wooden_cabinet_1_attic_region'"),
        (Atom("open", (TOMATO,)), "cannot be opened"),
        (Atom("turnon", ("wooden_cabinet_1_top_region",)), "'turnon' has no meaning"),
        (Atom("wasopen", ("wooden_cabinet_1_top_region",)), "cannot answer 'wasopen'"),
    ],
)
def test_wrong_atoms_are_told_in_one_sentence(simulate: Simulate, atom: Atom, words: str) -> None:
    with pytest.raises(MemobenchError, match=words) as caught:
        simulate().holds(atom)
    assert "\n" not in str(caught.value)
