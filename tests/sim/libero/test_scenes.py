"""A seed gives the scene that stock LIBERO draws from it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.sim.object_layout import SLOTS, WIDTH, field
from lerobot_memobench.sim.object_slots import ObjectSlots, classes
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import task_names
from tests.support.libero import needs_assets, record, simulate, some_of_all
from tests.support.scripts import load_script

EQUAL = 1e-9
"""Of poses, m."""
RECORDED = "3.3.7"
"""MuJoCo's version in the records."""
FALLEN = 1e-2
"""How far another version may let things fall and turn on each other, m and quaternion."""


def apart(sim: Simulation, seeds: range) -> float:
    """Return the largest difference of any pose or joint from LIBERO's, over seeds."""
    script, kept = load_script("libero_records"), record("scenes")
    worst = 0.0
    for seed in seeds:
        sim._placer.place(seed)
        k = script.SEEDS.index(seed)
        worst = max(worst, np.abs(sim.data.qpos[9:] - kept[f"{sim.task.name}:qpos"][k, 9:] * script.GRAIN).max())
        poses = np.array(list(sim.fixture_poses().values())).reshape(-1, 7)
        wanted = kept[f"{sim.task.name}:fixtures"][k] * script.GRAIN
        worst = max(worst, np.abs(poses - wanted).max(initial=0.0))
    return worst


@needs_assets
@pytest.mark.parametrize("name", some_of_all(task_names()))
def test_scenes_of_evaluation_seeds(name: str) -> None:
    assert apart(simulate(name), range(7, 57)) <= EQUAL


@needs_assets
@pytest.mark.parametrize("name", some_of_all(task_names()))
def test_a_reset_settles_as_stock_libero(name: str) -> None:
    sim = simulate(name)
    sim.reset(7)
    apart = np.abs(sim.data.qpos - record("scenes")[f"{name}:settled"])
    assert apart[:9].max() <= EQUAL
    assert apart.max() <= (EQUAL if mujoco.__version__ == RECORDED else FALLEN)


@needs_assets
def test_a_reset_repeats_to_the_bit() -> None:
    sim = simulate("open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate")
    sim.reset(7)
    first = sim.state()
    sim.reset(8)
    assert not np.array_equal(first, sim.state())
    sim.reset(7)
    assert np.array_equal(first, sim.state())


SHELF = "turn_on_the_stove_and_turn_it_off_near_the_shelf"


@needs_assets
def test_things_are_seen_as_object_slots() -> None:
    sim = simulate(SHELF)
    sim.reset(7)
    assert {"knob", "flat_stove", "chefmate_8_frypan", "wooden_two_layer_shelf"} <= classes_seen(sim)


@needs_assets
@pytest.mark.slow
def test_things_are_drawn() -> None:
    sim = simulate(SHELF)
    sim.reset(7)
    geoms, model = sim.geoms(), sim._drawing()[0]
    drawn = {model.body(model.body_rootid[model.geom_bodyid[geom]]).name for geom in np.unique(geoms[geoms >= 0])}
    assert set(sim.assets) <= drawn


@needs_assets
def test_drawers_are_seen_apart_and_keep_their_slots() -> None:
    sim = simulate("check_the_middle_drawer_of_the_cabinet")
    sim.reset(7)
    parts = sim.assets["wooden_cabinet_1"].articulations
    look = ObjectSlots(sim)
    shut = drawers(look)
    heights = field(shut, "position")[:, 2]
    assert len(shut) == len(parts)
    assert np.all(np.diff(heights) < -0.05), "from the top, each at its own height"
    for region, part in parts.items():
        pulled = sim.data.joint(part.joint).qpos
        pulled[:] = part.open_q
        mujoco.mj_forward(sim.model, sim.data)
        drawn, seen = list(parts).index(region), drawers(look)
        pulled[:] = 0.0
        at = {round(float(height), 3): row for height, row in zip(field(seen, "position")[:, 2], seen, strict=True)}
        assert field(at[round(float(heights[drawn]), 3)], "joint")[0] == np.float32(part.open_q)
        assert list(at) == sorted(at, reverse=True)


def drawers(look: ObjectSlots) -> NDArray[np.float32]:
    """Return the slots (n, WIDTH) of the drawers that are seen."""
    seen = look.observe().reshape(SLOTS, WIDTH)
    return seen[(field(seen, "present")[:, 0] > 0) & (field(seen, "class")[:, 0] == classes().index("drawer"))]


def classes_seen(sim: Simulation) -> set[str]:
    """Return the classes that an object observation shows."""
    seen = ObjectSlots(sim).observe().reshape(SLOTS, WIDTH)
    kinds = field(seen, "class")[field(seen, "present") > 0]
    return {classes()[int(kind)] for kind in kinds}
