"""The present picture tells nothing of the past: events, and what was hidden where, leave no trace in strict scenes.

What may differ, stated here for all of the suite:

- fixtures: 1e-6 m or rad; loose things 1e-4 m (they creep by microns while time passes, whatever is done).
- the arm when it has come home: not a bit.
- the first execution observation, between the variants of a seed, of published tasks with a prompt as well: not a bit.
- pictures with the arm where it was: 3 of 255 levels, but for `EDGES` pixels on outlines, which a micron can turn over.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs.episode import Episode, first_execution_step
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.observations import BOTH, RESET
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.protocol import ACTION_DIM, EXECUTION
from lerobot_memobench.sim.gl.rasterizer import Image
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, classes
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

FIXTURES, THINGS = 1e-6, 1e-4
SAME_LEVEL, EDGES = 3, 4
ARM = 9
"""The first positions and velocities of a scene: arm and fingers."""

EVENTS = {
    "check_the_top_drawer_a_given_number_of_times": ("open", "close", "wooden_cabinet_1_top_region"),
    "check_the_middle_drawer_a_given_number_of_times": ("open", "close", "wooden_cabinet_1_middle_region"),
    "check_all_three_drawers_once_each_in_the_given_order": ("open", "close", "wooden_cabinet_1_bottom_region"),
    "open_and_close_the_microwave_a_given_number_of_times": ("open", "close", "microwave_1"),
    "turn_the_stove_on_and_off_a_given_number_of_times": ("turnon", "turnoff", "flat_stove_1"),
    "turn_the_stove_on_and_off_near_the_shelf_a_given_number_of_times": ("turnon", "turnoff", "flat_stove_1"),
}


ALIKE = {
    "check_the_top_drawer_a_given_number_of_times",
    "turn_the_stove_on_and_off_near_the_shelf_a_given_number_of_times",
}
"""Those of them that move what another one moves."""


def pictures(sim: Simulation) -> dict[str, Image]:
    return {camera: sim.render(camera).copy() for camera in MJCF_CAMERAS}


def check_same(before: dict[str, Image], after: dict[str, Image]) -> None:
    for camera, image in before.items():
        apart = np.abs(image.astype(int) - after[camera]).max(axis=-1)
        assert (apart > SAME_LEVEL).sum() <= EDGES, camera


def fixture_joints(sim: Simulation) -> dict[str, float]:
    joints = [articulation.joint for asset in sim.assets.values() for articulation in asset.articulations.values()]
    return {joint: float(sim.data.joint(joint).qpos[0]) for joint in joints}


def check_state(sim: Simulation, joints: dict[str, float], places: dict[str, NDArray[np.float64]]) -> None:
    for joint, q in fixture_joints(sim).items():
        assert abs(q - joints[joint]) < FIXTURES, joint
    for thing, place in places.items():
        assert np.linalg.norm(sim.body_pose(thing)[0] - place) < THINGS, thing


def events(sim: Simulation, name: str, seed: int) -> Iterator[int]:
    """Let the expert do a task's event and come home, over and over; yield how often it has been done."""
    begin, end, thing = EVENTS[name]
    expert = Expert(sim.task, sim, np.random.default_rng(seed))
    done = 0
    while True:
        for atom in (Atom(begin, (thing,)), Atom(end, (thing,)), Atom("handhome", ())):
            for action in expert.achieve(atom):
                sim.step(action)
        done += 1
        yield done


@pytest.mark.parametrize("seed", [20_000, pytest.param(20_001, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in EVENTS]
)
def test_an_event_leaves_no_trace(name: str, seed: int, gl: str) -> None:
    sim = Simulation(get_task(name))
    sim.reset(seed)
    look = ObjectSlots(sim)
    arm, seen, slots = sim.data.qpos[:ARM].copy(), pictures(sim), look.observe()
    joints, places = fixture_joints(sim), {thing: sim.body_pose(thing)[0] for thing in sim.task.objects}
    for done in events(sim, name, seed):
        check_state(sim, joints, places)
        np.testing.assert_array_equal(sim.data.qpos[:ARM], arm)
        np.testing.assert_allclose(look.observe(), slots, atol=THINGS)
        check_same(seen, pictures(sim))
        if done == 2:
            break


def hidden(name: str, variant: int, seed: int) -> Episode:
    """Return an episode at its first execution frame."""
    episode = Episode(get_task(name).variant(variant), demonstration_prompt=False)
    episode.reset(seed)
    while episode.phase != EXECUTION:
        episode.step(np.zeros(ACTION_DIM, np.float32))
    return episode


def classes_seen(sim: Simulation) -> list[str]:
    """Return the class of each thing that a camera sees."""
    rows = ObjectSlots(sim).observe().reshape(SLOTS, WIDTH)
    return [classes()[int(row[STARTS["class"]])] for row in rows if row[STARTS["present"]]]


DRAWN = [name for name in task_names(suite=None) if get_task(name).num_variants > 1]
QUICK = {
    "find_the_charger_hidden_in_one_of_the_drawers",
    "put_the_butter_into_the_bowl_from_the_prompt_video",
    "turn_the_stove_on_and_off_a_given_number_of_times",
}


@pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in DRAWN]
)
def test_every_variant_of_a_seed_begins_its_execution_alike(
    name: str, monkeypatch: pytest.MonkeyPatch, gl: str
) -> None:
    """Pictures, objects, arm and clock: what was shown, hidden or asked for is in none of them, to the bit."""
    task = get_task(name)
    env = MemobenchEnv(task.name, obs_type=BOTH, referent="random", prompt_in=RESET)
    first: dict[str, NDArray[np.generic]] = {}
    for variant in task.random_variants:

        def chosen(published: Task, seed: int, variant: int = variant) -> Task:
            return published.variant(variant)

        monkeypatch.setattr(episode_module, "referent_of", chosen)
        seen, _ = env.reset(seed=20_003)
        assert env.episode.task.variant_index == variant
        assert env.episode.prompt_shown is not False
        sim = env.episode.sim
        arm = np.append(sim.data.qpos[:ARM], sim.data.qvel[:ARM])
        fixtures = np.array(list(fixture_joints(sim).values()))
        now = {**seen.pop("pixels"), **seen, "arm": arm, "fixtures": fixtures}
        assert now["step"] == [first_execution_step(task, 20_003, True)]
        first = first or now
        for part, value in now.items():
            np.testing.assert_array_equal(value, first[part], err_msg=f"{part} of variant {variant}")
    env.close()


def test_a_hidden_thing_is_out_of_sight_and_the_rest_is_as_it_was(gl: str) -> None:
    name = "find_the_tomato_or_the_biscuit_hidden_in_two_of_the_drawers"
    sim = Simulation(get_task(name))
    sim.reset(20_000)
    episode = hidden(name, 0, 20_000)
    gone = [thing for thing, _ in episode.task.prompt.places]  # type: ignore[union-attr]
    left = {thing: sim.body_pose(thing)[0] for thing in sim.task.objects if thing not in gone}
    check_state(episode.sim, fixture_joints(sim), left)
    for arm in ("qpos", "qvel"):
        np.testing.assert_array_equal(getattr(episode.sim.data, arm)[:ARM], getattr(sim.data, arm)[:ARM])
    assert "beefsteak_tomato" in classes_seen(sim)  # the biscuit lies outside both pictures
    assert not {"beefsteak_tomato", "biscuit"} & set(classes_seen(episode.sim))
