"""LIBERO's own suites equal stock LIBERO in models, starts, predicates and the step of success.

`scripts/libero_suite_records.py` makes the records with MuJoCo 3.3.7; `scripts/libero_suite_compare.py` compares more.
Since 3.4.0 MuJoCo reports the whole depth of contacts of boxes, 3.3.7 half of it, so that objects which start inside a
table leave it faster.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim.libero.scene import get_scene
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom, atoms
from lerobot_memobench.tasks.libero_suites import get_libero_task, initial_states, libero_tasks
from tests.support.libero import record
from tests.support.scripts import load_script

SCRIPT = load_script("libero_records")
EQUAL = 1e-9
"""Tolerance of poses, m, and of sums over a field as a share of its magnitude: MuJoCo's versions round differently."""
RECORDED = "3.3.7"
"""MuJoCo's version in the records."""
SETTLED = 2e-4
"""Tolerance of objects at rest in other versions, m and quaternion."""
STEPS = 5
"""Largest difference of the step of success in other versions, in which touched objects move differently."""
TASKS = {"libero_spatial": 2, "libero_object": 1, "libero_goal": 6, "libero_10": 7, "libero_90": 0}
"""Suite -> id of the task with records of all kinds."""
SUITES = [
    "libero_spatial",
    *(pytest.param(suite, marks=pytest.mark.slow) for suite in TASKS if suite != "libero_spatial"),
]
ARENAS = {
    "pick_up_the_black_bowl_from_table_center_and_place_it_on_the_plate": "table",
    "pick_up_the_alphabet_soup_and_place_it_in_the_basket": "floor",
    "KITCHEN_SCENE4_put_the_wine_bottle_on_the_wine_rack": "kitchen",
    "LIVING_ROOM_SCENE4_pick_up_the_black_bowl_on_the_left_and_put_it_in_the_tray": "living room",
    "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_front_compartment_of_the_caddy": "study",
}
"""One task of each arena."""


def all_tasks() -> list[str]:
    """Return the 130 tasks in the order of the records."""
    return [name for suite in TASKS for name in libero_tasks(suite)]


def of_each_arena() -> list[Any]:
    """Return all tasks as parameters of a test; all but one of each arena are slow."""
    return [name if name in ARENAS else pytest.param(name, marks=pytest.mark.slow) for name in all_tasks()]


def recorded(suite: str, kind: str) -> tuple[Simulation, dict[str, Any]]:
    """Return the simulation of a suite's recorded task, and its records of a kind."""
    start = f"{suite}:{kind}:"
    kept = {key.removeprefix(start): values for key, values in record("suites").items() if key.startswith(start)}
    assert kept
    return Simulation(get_libero_task(libero_tasks(suite)[TASKS[suite]])), kept


def begin(sim: Simulation, episode: int) -> None:
    """Reset to an episode."""
    sim.reset(7 + episode, state=initial_states(sim.task.name)[episode])


def succeeds(sim: Simulation) -> bool:
    """Return whether the goal holds."""
    return all(sim.holds(atom) for atom in atoms(sim.task.goal))


def test_tasks_are_in_liberos_order() -> None:
    assert all_tasks() == record("suites")["tasks"].tolist()


@pytest.mark.parametrize("name", of_each_arena())
def test_the_model_is_stock_liberos(name: str) -> None:
    kept = record("suites")
    wanted = dict(zip(kept["fields"], kept["fingerprints"][all_tasks().index(name)], strict=True))
    found = SCRIPT.fields(get_scene(get_libero_task(name)).model)
    assert list(found) == list(wanted)
    differ = {
        field: (ours.tolist(), wanted[field].tolist())
        for field, values in found.items()
        for ours in [SCRIPT.fingerprint(values)]
        if not np.allclose(ours, wanted[field], rtol=0, atol=EQUAL * (wanted[field][2] + 1e-6))
    }
    assert differ == {}


@pytest.mark.parametrize("suite", SUITES)
def test_episodes_start_as_in_stock_libero(suite: str) -> None:
    sim, kept = recorded(suite, "first_states")
    for episode in range(len(kept["qpos"])):
        begin(sim, episode)
        fixtures = np.array(list(sim.fixture_poses().values())).reshape(-1, 7)
        assert np.abs(fixtures - kept["fixtures"][episode]).max(initial=0.0) <= EQUAL
        away = np.abs(sim.data.qpos - kept["qpos"][episode])
        assert away[:9].max() <= EQUAL
        assert succeeds(sim) == kept["success"][episode]
        if mujoco.__version__ == RECORDED:
            assert away.max() <= EQUAL
        elif suite != "libero_10":  # its objects start inside the table
            assert away.max() <= SETTLED


@pytest.mark.parametrize("suite", SUITES)
def test_predicates_and_goals_are_stock_liberos(suite: str) -> None:
    sim, kept = recorded(suite, "predicates")
    goal = [Atom(word, tuple(names)) for word, *names in (str(one).split() for one in kept["atoms"])]
    fixtures = dict(zip(sim.fixture_poses(), kept["fixtures"], strict=True))
    found = []
    for qpos in kept["qpos"]:
        sim.set_state(np.concatenate([[0.0], qpos / 1e6, np.zeros(sim.model.nv)]), fixtures)
        found.append([*(sim.holds(atom) for atom in goal), succeeds(sim)])
    assert np.array(found).tolist() == kept["answers"].tolist()
    assert 0 < np.mean(kept["answers"]) < 1


@pytest.mark.parametrize("suite", SUITES)
def test_a_scripted_execution_succeeds_at_the_same_step(suite: str) -> None:
    sim, kept = recorded(suite, "successes")
    begin(sim, 0)
    success = 0
    for action in [*kept["actions"], *[kept["actions"][-1]] * STEPS]:
        sim.step(action)
        success += 1
        if succeeds(sim):
            break
    else:
        pytest.fail(f"no success in {success} steps, {kept['success']} in stock LIBERO")
    assert abs(success - kept["success"]) <= (0 if mujoco.__version__ == RECORDED else STEPS)
