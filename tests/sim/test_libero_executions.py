"""LIBERO's suites equal stock LIBERO in models, the step of success of scripted executions, and observations.

The records are of MuJoCo 3.3.7.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim.robot import SUBSTEPS
from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import atoms
from lerobot_memobench.tasks.libero_suites import LIBERO_SUITES, get_libero_task, initial_states, libero_tasks
from tests.support.libero import fields, fingerprint, record

RECORDED = "3.3.7"
"""MuJoCo's version in the record."""
EQUAL = 1e-9
"""Tolerance of sums over a field as a share of its magnitude: MuJoCo's versions round differently."""
STEPS = 5
"""Largest difference of the step of success in other versions, in which touched objects move differently."""
AT_REST, OBSERVED = 3e-4, 1e-6
"""Tolerance of the observed state after the reset, when the arm still moves slowly, and at equal times."""
PICTURE, MIRRORED = 4.0, 20.0
"""Largest mean difference of a picture, and least one of a mirrored picture, of 255."""
ONE_OF_EACH_ARENA = (
    "pick_up_the_black_bowl_from_table_center_and_place_it_on_the_plate",
    "pick_up_the_alphabet_soup_and_place_it_in_the_basket",
    "KITCHEN_SCENE4_put_the_wine_bottle_on_the_wine_rack",
    "LIVING_ROOM_SCENE4_pick_up_the_black_bowl_on_the_left_and_put_it_in_the_tray",
    "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_front_compartment_of_the_caddy",
)
TASKS = [name for suite in LIBERO_SUITES for name in libero_tasks(suite)]
SOME = [name if name in ONE_OF_EACH_ARENA else pytest.param(name, marks=pytest.mark.slow) for name in TASKS]
SUITES = [pytest.param(suite, marks=pytest.mark.slow) if suite == "libero_10" else suite for suite in LIBERO_SUITES]


def test_tasks_are_in_liberos_order() -> None:
    assert sorted(TASKS) == sorted(record("executions")["tasks"])
    for suite in LIBERO_SUITES:
        names = [name for name in record("executions")["tasks"] if name in libero_tasks(suite)]
        assert tuple(names) == libero_tasks(suite)


@pytest.mark.parametrize("name", SOME)
def test_the_model_is_stock_liberos(name: str) -> None:
    kept = record("executions")
    wanted = dict(zip(kept["fields"], kept["fingerprints"][kept["tasks"].tolist().index(name)], strict=True))
    found = fields(get_scene(get_libero_task(name)).model)
    assert list(found) == list(wanted)
    differ = {
        field: (ours.tolist(), wanted[field].tolist())
        for field, values in found.items()
        for ours in [fingerprint(values)]
        if not np.allclose(ours, wanted[field], rtol=0, atol=EQUAL * (wanted[field][2] + 1e-6))
    }
    assert differ == {}


@pytest.mark.parametrize("suite", SUITES)
def test_a_scripted_execution_succeeds_at_the_same_step(suite: str) -> None:
    kept = {
        key.partition(":")[2]: values for key, values in record("executions").items() if key.startswith(f"{suite}:")
    }
    name, actions = libero_tasks(suite)[kept["task_id"]], kept["actions"]
    sim = Simulation(get_libero_task(name))
    sim.reset(7, state=initial_states(name)[0])
    success = 0
    for action in [*actions, *[actions[-1]] * STEPS]:
        sim.step(action)
        success += 1
        if all(sim.holds(atom) for atom in atoms(sim.task.goal)):
            break
    else:
        pytest.fail(f"no success in {success} steps; in stock LIBERO at step {len(actions)}")
    assert abs(success - len(actions)) <= (0 if mujoco.__version__ == RECORDED else STEPS)


@pytest.mark.parametrize("suite", ["libero_spatial", pytest.param("libero_object", marks=pytest.mark.slow)])
def test_observations_are_those_of_lerobots_libero(suite: str) -> None:
    """robosuite observes fingers 2 ms and the hand 4 ms before the end of a control step; pictures bottom up."""
    start, kept = f"{suite}:", record("observations")
    seen = {key.removeprefix(start): values for key, values in kept.items() if key.startswith(start)}
    name = libero_tasks(suite)[{"libero_spatial": 0, "libero_object": 3}[suite]]
    sim = Simulation(get_libero_task(name))
    sim.reset(7, state=initial_states(name)[0])
    assert np.abs(sim.proprio() - seen["0.processed.observation.state"][0]).max() <= AT_REST
    for camera, image in (("agentview", "image"), ("wrist", "image2")):
        ours, theirs = sim.render(camera)[::-1].astype(int), seen[f"0.raw.pixels.{image}"]
        assert np.abs(ours[::4, ::4] - theirs).mean() <= PICTURE
        assert np.abs(ours[:, ::-1][::4, ::4] - theirs).mean() >= MIRRORED
    for step in range(2):
        action = seen[f"{step}.action"]
        sim._controller.set_goal(sim.data, action)
        sim._controller.advance(sim.data, float(action[6]), SUBSTEPS - 2)
        hand = sim.proprio()
        sim._controller.advance(sim.data, float(action[6]), 1)
        state = [*hand[:6], *sim.proprio()[6:]]
        sim._controller.advance(sim.data, float(action[6]), 1)
        assert np.abs(state - seen[f"{step + 1}.processed.observation.state"][0]).max() <= OBSERVED
