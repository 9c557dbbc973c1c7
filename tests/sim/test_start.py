"""Is the hand home, is a thing in its place? Compared with how the episode, and its execution, began."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.sim.start import HOME_ANGLE, HOME_DISTANCE, PLACE_DISTANCE
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom

TASK, BOWL = "open_and_close_the_microwave_a_given_number_of_times", "white_bowl_1"
HOME, IN_PLACE = Atom("handhome", ()), Atom("inplace", (BOWL,))


@pytest.fixture
def sim() -> Simulation:
    sim = Simulation(get_task(TASK))
    sim.reset(20_000)
    return sim


def act(sim: Simulation, steps: int, **values: float) -> None:
    """Take steps of one action, named by what it moves."""
    action = NO_OP.copy()
    for name, value in values.items():
        action[["x", "y", "z", "rx", "ry", "rz", "grip"].index(name)] = value
    for _ in range(steps):
        sim.step(action)


def test_home_is_where_the_hand_settled_and_stays_home_at_rest(sim: Simulation) -> None:
    for _ in range(60):
        assert sim.holds(HOME)
        act(sim, 1)


@pytest.mark.parametrize("move", [{"x": 0.5}, {"z": 0.5}, {"rz": 0.5}, {"grip": 1.0}])
def test_a_hand_that_is_moved_turned_or_shut_is_not_home(sim: Simulation, move: dict[str, float]) -> None:
    act(sim, 15, **move)
    assert not sim.holds(HOME)


def test_tolerances_are_the_stated_ones(sim: Simulation) -> None:
    start, rotation = sim.eef_pose()
    was_home = True
    for _ in range(30):
        act(sim, 1, y=0.15, rx=0.05)
        place, turned = sim.eef_pose()
        angle = np.arccos(np.clip((np.trace(rotation.T @ turned) - 1) / 2, -1, 1))
        within = bool(np.linalg.norm(place - start) <= HOME_DISTANCE and angle <= HOME_ANGLE)
        assert sim.holds(HOME) == within
        was_home &= within
    assert not was_home


def test_home_again_after_coming_back(sim: Simulation) -> None:
    start = sim.snapshot()
    act(sim, 15, x=0.5)
    sim.restore(start)
    assert sim.holds(HOME)
    sim.reset(20_001)
    assert sim.holds(HOME)


def test_a_thing_is_in_its_place_up_to_the_stated_distance(sim: Simulation) -> None:
    joint = sim.data.joint(f"{BOWL}_joint0")
    for shift, expected in ((0.9 * PLACE_DISTANCE, True), (1.1 * PLACE_DISTANCE, False)):
        state = sim.state()
        joint.qpos[1] += shift
        sim.set_state(sim.state())
        assert sim.holds(IN_PLACE) == expected
        sim.set_state(state)
    assert sim.holds(IN_PLACE)


def test_places_are_those_at_the_beginning_of_the_execution(sim: Simulation) -> None:
    sim.data.joint(f"{BOWL}_joint0").qpos[1] += 0.1
    sim.set_state(sim.state())
    assert not sim.holds(IN_PLACE)
    sim.begin_execution()
    assert sim.holds(IN_PLACE)
    assert sim.holds(HOME)


def test_a_twin_begins_as_its_published_task_does() -> None:
    twin, published = Simulation(get_task(TASK)), Simulation(get_task("open_and_close_the_microwave"))
    for seed in (7, 20_000):
        twin.reset(seed)
        published.reset(seed)
        assert set(twin.assets) == set(published.assets)
        for name in twin.assets:
            for ours, theirs in zip(twin.body_pose(name), published.body_pose(name), strict=True):
                np.testing.assert_allclose(ours, theirs, atol=1e-4)
