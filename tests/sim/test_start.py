"""Is the hand home, is a thing in its place? Compared with how the episode, and its execution, began."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.sim.world import DETENT_DISTANCE, PLACE_DISTANCE
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


def arm(sim: Simulation) -> bytes:
    """What the arm could carry on: joints, fingers, their speeds, what the controller holds."""
    kept = sim.snapshot()
    parts = (sim.data.qpos[:9], sim.data.qvel[:9], kept.goal_position, kept.goal_rotation, kept.gripper)
    return b"".join(part.tobytes() for part in parts)


@pytest.mark.parametrize(
    "move", [{}, {"x": 0.25}, {"y": -0.2, "z": 0.2}, {"rx": 0.15}, {"y": 0.2, "rz": -0.1}, {"z": 0.2, "grip": 1.0}]
)
def test_a_hand_that_rests_near_home_stands_as_at_first_to_the_bit(sim: Simulation, move: dict[str, float]) -> None:
    """No policy can leave itself a note in where, or how, it stands at home."""
    first = arm(sim)
    act(sim, 3, **move)
    assert (arm(sim) == first) == (not move)
    act(sim, 30)
    assert arm(sim) == first
    assert sim.holds(HOME)


def test_a_hand_that_passes_or_rests_farther_away_is_not_home(sim: Simulation) -> None:
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


def test_who_leaves_home_in_the_very_first_step_was_there(sim: Simulation) -> None:
    states = [sim.state()]
    for expected in (True, False):
        act(sim, 1, x=1.0)
        assert sim.holds(HOME) == expected
        states.append(sim.state())
    sim.set_state(states[0])
    for state, expected in zip(states[1:], (True, False), strict=True):  # and so where states are read from a file
        sim.set_state(state)
        assert sim.holds(HOME) == expected


def test_a_small_action_leaves_home(sim: Simulation) -> None:
    act(sim, 3, x=0.2)
    assert not sim.holds(HOME)


def test_published_scenes_have_no_detent() -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"))
    sim.reset(20_000)
    act(sim, 3, x=0.25)
    act(sim, 30)
    assert np.linalg.norm(sim.eef_pose()[0] - sim.home[0]) > 0.005


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


def test_a_strict_task_begins_as_its_published_task_does() -> None:
    strict, published = Simulation(get_task(TASK)), Simulation(get_task("open_and_close_the_microwave"))
    for seed in (7, 20_000):
        strict.reset(seed)
        published.reset(seed)
        assert set(strict.assets) == set(published.assets)
        for name in strict.assets:
            for ours, theirs in zip(strict.body_pose(name), published.body_pose(name), strict=True):
                np.testing.assert_allclose(ours, theirs, atol=1e-4)
