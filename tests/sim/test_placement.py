"""Strict scenes begin inside their regions, free of overlap and at rest; impossible placements are errors."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.asset import TABLE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import STRICT, Task

DEEPEST = 0.002
"""Largest contact depth at rest, m."""
MAX_REST_SPEED, MAX_REST_ROTATION = 0.01, 0.3
"""Largest speed of an object at rest, m/s and rad/s."""
MOVED = 0.005
"""Largest displacement while settling, m."""


def outside_their_regions(sim: Simulation) -> list[str]:
    """Return the objects outside their regions, with a tolerance for settling."""
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
    """Return the problems of an initial state."""
    found = outside_their_regions(sim)
    model, data = sim.model, sim.data
    for contact in data.contact[: data.ncon] if data.ncon else ():
        if contact.dist < -DEEPEST:
            names = [model.body(model.geom_bodyid[geom]).name for geom in contact.geom]
            found.append(f"{names[0]} overlaps {1e3 * -contact.dist:.1f} mm with {names[1]}")
    for name, asset in sim.assets.items():
        if asset.kind != "object":
            continue
        velocity = data.joint(f"{name}_joint0").qvel
        if np.linalg.norm(velocity[:3]) > MAX_REST_SPEED or np.linalg.norm(velocity[3:]) > MAX_REST_ROTATION:
            found.append(f"{name} moves: {np.round(velocity, 3).tolist()}")
    for atom in sim.task.init:
        if len(atom.args) == 1 and not sim.holds(atom):
            found.append(f"{atom} does not hold")
    return found


@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        *((name, range(7, 10)) for name in task_names(suite=STRICT)[::10]),
        *(pytest.param(name, range(100), marks=pytest.mark.slow) for name in task_names(suite=STRICT)),
    ],
)
def test_initial_states(name: str, seeds: range) -> None:
    sim = Simulation(get_task(name))
    wrong = {}
    for seed in seeds:
        sim.reset(seed)
        if found := problems(sim):
            wrong[seed] = found
    assert not wrong


SPOT = ((0.0, 0.0, 0.001, 0.001),)


def crowded(task: Task) -> Task:
    regions = {name: dataclasses.replace(region, ranges=SPOT) for name, region in task.regions.items()}
    return dataclasses.replace(task, name="crowded", regions=regions)


def without_a_place(task: Task) -> Task:
    init = tuple(atom for atom in task.init if atom.args[0] != "butter_1")
    return dataclasses.replace(task, name="without a place", init=init)


def in_a_cycle(task: Task) -> Task:
    init = tuple(atom for atom in task.init if atom.args[0] not in ("butter_1", "bowl_left"))
    cycle = (Atom("on", ("butter_1", "bowl_left")), Atom("on", ("bowl_left", "butter_1")))
    return dataclasses.replace(task, name="cycle", init=init + cycle)


@pytest.mark.parametrize(
    ("change", "fragment"), [(crowded, "overlapped"), (without_a_place, "'butter_1'"), (in_a_cycle, "has no place yet")]
)
def test_impossible_placements_are_errors(change: Callable[[Task], Task], fragment: str) -> None:
    with pytest.raises(MemobenchError, match=fragment):
        Simulation(change(get_task("put_the_butter_into_the_bowl_from_the_prompt_video"))).reset(0)


def test_object_in_an_open_drawer() -> None:
    """Forms of `:init` that the catalogue rarely uses."""
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
