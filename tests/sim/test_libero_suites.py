"""Scenes of LIBERO's suites equal those of stock LIBERO.

`suites.npz` holds records of hf-libero 0.1.4 with MuJoCo 3.3.7: for 25 tasks, which have all predicates of LIBERO's
goals, the state after the reset to episode 0 (seed 7) and the goal's atoms in 25 other states.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.classes import ARENAS, CLASSES, SUITE_CLASSES, arena_of
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.libero_suites import LIBERO_SUITES, get_libero_task, initial_states, libero_tasks
from tests.support.libero import mujocos, record, recorded_answers, whole_model

RECORDED = "3.3.7"
"""MuJoCo's version in the records."""
EQUAL, CLOSE = 1e-9, 5e-4
"""Tolerance of poses, m and quaternion, in this version and in others."""
ONE_OF_EACH_ARENA = {
    "table": "open_the_middle_drawer_of_the_cabinet",
    "floor": "pick_up_the_alphabet_soup_and_place_it_in_the_basket",
    "living_room_table": "LIVING_ROOM_SCENE2_put_both_the_alphabet_soup_and_the_tomato_sauce_in_the_basket",
    "study_table": "STUDY_SCENE1_pick_up_the_book_and_place_it_in_the_back_compartment_of_the_caddy",
    "kitchen_table": "KITCHEN_SCENE4_put_the_black_bowl_in_the_bottom_drawer_of_the_cabinet_and_close_it",
}
FLOOR = ONE_OF_EACH_ARENA["floor"]
TASKS = sorted({key.partition(":")[0] for key in record("suites")})
SOME = [name if name in ONE_OF_EACH_ARENA.values() else pytest.param(name, marks=pytest.mark.slow) for name in TASKS]


def start(name: str, seed: int = 7, state: int = 0) -> Simulation:
    sim = Simulation(get_libero_task(name))
    sim.reset(seed, state=initial_states(name)[state])
    return sim


def test_records_cover_all_predicates_and_arenas() -> None:
    atoms = {str(atom).split()[0] for name in TASKS for atom in record("suites")[f"{name}:atoms"]}
    assert atoms == {"in", "on", "open", "close", "turnon", "turnoff"}
    assert {arena_of(get_libero_task(name)).file for name in TASKS} == {arena.file for arena in ARENAS.values()}
    assert [arena_of(get_libero_task(name)) for name in ONE_OF_EACH_ARENA.values()] == [
        ARENAS[table] for table in ONE_OF_EACH_ARENA
    ]


@pytest.mark.parametrize("name", SOME)
def test_a_reset_to_an_initial_state_equals_stock_libero(name: str) -> None:
    sim, kept = start(name), record("suites")
    fixtures = np.array(list(sim.fixture_poses().values())).reshape(-1, 7)
    assert np.abs(fixtures - kept[f"{name}:start_fixtures"]).max(initial=0.0) <= EQUAL
    apart = np.abs(sim.data.qpos - kept[f"{name}:start"])
    assert apart[:9].max() <= EQUAL
    assert apart.max() <= (EQUAL if mujoco.__version__ == RECORDED else CLOSE)


@pytest.mark.parametrize("name", SOME)
def test_atoms_of_goals_equal_stock_libero(name: str) -> None:
    sim, kept = Simulation(get_libero_task(name)), record("suites")
    _, found = recorded_answers(sim, kept, name)
    assert np.array_equal([[*held, all(held)] for held in found], kept[f"{name}:answers"])
    assert kept[f"{name}:answers"].any()


def test_resets_repeat_to_the_bit_and_the_seed_moves_fixtures_only() -> None:
    name = ONE_OF_EACH_ARENA["kitchen_table"]
    sim, other = start(name), start(name, seed=8)
    first, poses = sim.state(), sim.fixture_poses()
    moved = {key for key, pose in other.fixture_poses().items() if not np.array_equal(pose, poses[key])}
    assert moved == {"white_cabinet_1", "wine_rack_1"}
    sim.reset(9, state=initial_states(name)[3])
    assert not np.array_equal(sim.state(), first)
    sim.reset(7, state=initial_states(name)[0])
    assert np.array_equal(sim.state(), first)


def test_groceries_inside_the_table_are_not_thrown() -> None:
    """With full depth of contacts a ketchup bottle is 0.5 m above the table after the reset."""
    name = ONE_OF_EACH_ARENA["living_room_table"]
    for state in range(3):
        sim = start(name, state=state)
        assert max(sim.data.body(thing).xpos[2] for thing in sim.task.objects) < 0.55


def test_a_state_of_another_task_is_refused() -> None:
    sim = Simulation(get_libero_task(FLOOR))
    with pytest.raises(MemobenchError, match=r"has shape \(79,\); expected \(110,\)"):
        sim.reset(7, state=initial_states("open_the_middle_drawer_of_the_cabinet")[0])


def test_object_observations_refuse_classes_of_the_suites() -> None:
    with pytest.raises(MemobenchError, match=r"use env\.obs_type=pixels_agent_pos$"):
        ObjectSlots(Simulation(get_libero_task(FLOOR)))
    assert not set(CLASSES) & set(SUITE_CLASSES)


def test_the_floor_is_as_dark_as_mujoco_draws_it() -> None:
    """Its texture is marked as sRGB. MuJoCo's renderer draws a mean of 98 there, and 144 without the conversion."""
    sim = start(FLOOR)
    floor = sim.visible_bodies("agentview") == sim.model.body("floor").id
    assert floor.mean() > 0.5
    assert sim.render("agentview")[floor].mean() == pytest.approx(98.5, abs=3)


@pytest.mark.slow
@pytest.mark.parametrize("suite", LIBERO_SUITES)
def test_all_scenes_compile_with_the_width_of_their_states(suite: str) -> None:
    for name in libero_tasks(suite):
        assert Simulation(get_libero_task(name)).state_dim == initial_states(name).shape[1]


@pytest.mark.slow
@pytest.mark.parametrize("name", ONE_OF_EACH_ARENA.values())
def test_images_equal_mujocos_renderer(name: str, mujoco_renderer: type[mujoco.Renderer]) -> None:
    sim = start(name)
    theirs = mujocos(sim, whole_model(sim), 0)
    for camera, image in zip(MJCF_CAMERAS, theirs, strict=True):
        error = np.abs(sim.render(camera).astype(int) - image).mean()
        assert error <= 3.0, f"{camera}: {error:.2f}"


def test_memory_tasks_stay_in_the_kitchen() -> None:
    assert arena_of(get_task("turn_on_the_stove_and_turn_it_off")) == ARENAS["kitchen_table"]
