"""Initial states: where the task says, nothing in anything else, and at rest once the episode begins."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets.kitchen import TABLE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom

DEEPEST = 0.002
"""How far things that rest on each other may sink in, m."""
STILL, SLOWLY_TURNING = 0.01, 0.3
"""Speed below which a thing is at rest, m/s and rad/s."""
MOVED = 0.005
"""How far a thing may slide while it settles, m."""


def placed_where_told(sim: Simulation) -> list[str]:
    """Return the things that are outside the regions they start in, with the slack of settling."""
    wrong = []
    for atom in sim.task.init:
        if atom.predicate != "on" or atom.args[1] not in sim.task.regions:
            continue
        region = sim.task.regions[atom.args[1]]
        if region.target != TABLE:
            continue
        x, y, _ = sim.body_pose(atom.args[0])[0]
        if not any(x1 - MOVED <= x <= x2 + MOVED and y1 - MOVED <= y <= y2 + MOVED for x1, y1, x2, y2 in region.ranges):
            wrong.append(f"{atom.args[0]} at ({x:.3f}, {y:.3f}) is outside {region.name}")
    return wrong


def problems(sim: Simulation) -> list[str]:
    """Return what is wrong with an initial state."""
    found = placed_where_told(sim)
    model, data = sim.model, sim.data
    for contact in data.contact[: data.ncon] if data.ncon else ():
        if contact.dist < -DEEPEST:
            names = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
            found.append(f"{names[0]} stands {1e3 * -contact.dist:.1f} mm in {names[1]}")
    for name, asset in sim.assets.items():
        if asset.kind != "object":
            continue
        velocity = data.joint(f"{name}_joint0").qvel
        if np.linalg.norm(velocity[:3]) > STILL or np.linalg.norm(velocity[3:]) > SLOWLY_TURNING:
            found.append(f"{name} moves: {np.round(velocity, 3).tolist()}")
    for atom in sim.task.init:
        if len(atom.args) == 1 and not sim.holds(atom):
            found.append(f"{atom} does not hold")
    return found


def check(name: str, seeds: range) -> None:
    sim = Simulation(get_task(name))
    wrong = {}
    for seed in seeds:
        sim.reset(seed)
        if found := problems(sim):
            wrong[seed] = found
    assert not wrong


@pytest.mark.parametrize("name", task_names())
def test_initial_states(name: str) -> None:
    check(name, range(7, 12))


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names())
def test_initial_states_of_many_seeds(name: str) -> None:
    check(name, range(500))


def test_whole_region_is_used() -> None:
    """Draws come from all over a region, not from a corner of it."""
    sim = Simulation(get_task("put_the_tomato_into_the_top_drawer_of_the_cabinet"))
    region = sim.task.regions["kitchen_table_beefsteak_tomato_init_region"]
    x1, y1, x2, y2 = region.ranges[0]
    sim.reset(0)
    rng = np.random.default_rng(0)
    points = np.array([sim._placer.draw(rng).poses["beefsteak_tomato__1_1"][:2] for _ in range(200)])
    shares = (points - [x1, y1]) / [x2 - x1, y2 - y1]
    assert shares.min() >= 0
    assert shares.max() <= 1
    assert np.all(np.abs(shares.mean(axis=0) - 0.5) < 0.08)
    assert np.all(np.abs(shares.std(axis=0) - 12**-0.5) < 0.06)


def test_too_crowded_a_table_is_told() -> None:
    task = get_task("put_the_butter_into_the_bowl_from_the_prompt_video")
    spot = (0.0, 0.0, 0.001, 0.001)
    regions = {
        name: dataclasses.replace(region, ranges=(spot,)) if isinstance(region, Region) else region
        for name, region in task.regions.items()
    }
    crowded = dataclasses.replace(task, name="crowded", regions=regions)
    with pytest.raises(MemobenchError, match=r"overlapped in each of \d+ draws"):
        Simulation(crowded).reset(0)


def test_a_thing_without_a_place_is_told() -> None:
    task = get_task("put_the_butter_into_the_bowl_from_the_prompt_video")
    init = tuple(atom for atom in task.init if atom.args[0] != "butter_1")
    with pytest.raises(MemobenchError, match="does not say where 'butter_1' starts"):
        Simulation(dataclasses.replace(task, name="without a place", init=init))


def test_things_on_each_other_in_a_circle_are_told() -> None:
    task = get_task("put_the_butter_into_the_bowl_from_the_prompt_video")
    init = tuple(atom for atom in task.init if atom.args[0] not in ("butter_1", "bowl_left"))
    circle = (Atom("on", ("butter_1", "bowl_left")), Atom("on", ("bowl_left", "butter_1")))
    with pytest.raises(MemobenchError, match="in a circle"):
        Simulation(dataclasses.replace(task, name="circle", init=init + circle))


def test_object_on_object_in_region_and_open_drawer() -> None:
    """The forms of `:init` that the catalogue itself uses little: on an object, in a drawer, opened."""
    task = get_task("put_the_tomato_into_the_top_drawer_of_the_cabinet")
    init = (
        *(atom for atom in task.init if atom.args[0] != "beefsteak_tomato__1_1"),
        Atom("in", ("beefsteak_tomato__1_1", "wooden_cabinet_1_top_region")),
        Atom("open", ("wooden_cabinet_1_top_region",)),
    )
    sim = Simulation(dataclasses.replace(task, name="in an open drawer", init=init))
    for seed in range(3):
        sim.reset(seed)
        assert sim.holds(Atom("open", ("wooden_cabinet_1_top_region",)))
        assert sim.holds(Atom("in", ("beefsteak_tomato__1_1", "wooden_cabinet_1_top_region")))
    task = get_task("put_the_butter_into_the_bowl_from_the_prompt_video")
    init = (
        *(atom for atom in task.init if atom.args[0] != "butter_1"),
        Atom("on", ("butter_1", "bowl_mid")),
    )
    sim = Simulation(dataclasses.replace(task, name="butter in a bowl", init=init))
    sim.reset(0)
    mujoco.mj_forward(sim.model, sim.data)
    assert sim.holds(Atom("on", ("butter_1", "bowl_mid")))
