"""Events, and what was hidden where, leave no trace in strict scenes, to the bit.

- At home after an event the observation is that of the execution's first frame.
- The first frame of an execution is the same for all variants of a seed, of published tasks with a prompt as well.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.memobench_env import MemobenchEnv
from lerobot_memobench.envs.settings import BOTH, OBJECTS, RESET
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.hand import Hand
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.protocol import ACTION_DIM, EXECUTION, NO_CLOCK
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, classes
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

FIXTURES, THINGS = 1e-6, 1e-4
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


def fixture_joints(sim: Simulation) -> dict[str, float]:
    joints = [articulation.joint for asset in sim.assets.values() for articulation in asset.articulations.values()]
    return {joint: float(sim.data.joint(joint).qpos[0]) for joint in joints}


def check_state(sim: Simulation, joints: dict[str, float], places: dict[str, NDArray[np.float64]]) -> None:
    for joint, q in fixture_joints(sim).items():
        assert abs(q - joints[joint]) < FIXTURES, joint
    for thing, place in places.items():
        assert np.linalg.norm(sim.body_pose(thing)[0] - place) < THINGS, thing


@pytest.mark.parametrize("seed", [20_000, pytest.param(20_001, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in EVENTS]
)
def test_an_event_leaves_no_trace(name: str, seed: int) -> None:
    env = MemobenchEnv(name, obs_type=BOTH, prompt_in=RESET)
    first, _ = env.reset(seed=seed)
    assert first["step"] == [NO_CLOCK]
    expert = Expert(env.episode.task, env.episode.sim, np.random.default_rng(seed))
    begin, end, thing = EVENTS[name]
    if "order" in name:
        thing = f"wooden_cabinet_1_{min(('top', 'middle', 'bottom'), key=env.task_description.index)}_region"
    for _ in range(1 if "once" in name else 2):
        for atom in (Atom(begin, (thing,)), Atom(end, (thing,)), Atom("asbegun", ())):
            for action in expert.achieve(atom):
                seen, *_ = env.step(np.clip(action, -1, 1).astype(np.float32))
        for camera, picture in first["pixels"].items():
            np.testing.assert_array_equal(seen["pixels"][camera], picture)
        for part in set(first) - {"pixels"}:
            np.testing.assert_array_equal(seen[part], first[part], err_msg=part)
    env.close()


UP = np.array([0, 0, 1, 0, 0, 0, -1], np.float32)
MARKS = {
    "a drawer ajar": ("check_the_top_drawer_a_given_number_of_times", "wooden_cabinet_1_bottom_region", -0.012),
    "a door ajar": ("open_and_close_the_microwave_a_given_number_of_times", "microwave_1", -0.2),
    "a knob between off and on": ("turn_the_stove_on_and_off_a_given_number_of_times", "flat_stove_1", 0.2),
}


@pytest.mark.parametrize("mark", MARKS)
def test_a_joint_left_ajar_loses_at_home(mark: str) -> None:
    """Stated by hand: a joint is put between its ends, and the hand comes home."""
    name, joint, q = MARKS[mark]
    env = MemobenchEnv(name, obs_type=OBJECTS, prompt_in=RESET)
    env.reset(seed=20_000)
    sim = env.episode.sim
    for _ in range(5):
        env.step(UP)
    sim.data.qpos[sim.world.joints[joint][1]] = q
    for action in come_home(Hand(sim, np.random.default_rng(0)), *sim.home):
        _, _, ended, _, _ = env.step(action.astype(np.float32))
        if ended:
            break
    assert env.episode.lost
    env.close()


@pytest.mark.parametrize(("shift", "counts"), [(0.0008, True), (0.003, False)])
def test_an_object_is_put_back_or_home_is_not_as_begun(shift: float, counts: bool) -> None:
    sim = Simulation(get_task("check_the_top_drawer_a_given_number_of_times"))
    sim.reset(20_000)
    start = np.append(sim.data.qpos, sim.data.qvel)
    for _ in range(5):
        sim.step(UP)
    sim.data.joint("akita_black_bowl_1_joint0").qpos[0] += shift
    for action in come_home(Hand(sim, np.random.default_rng(0)), *sim.home):
        sim.step(action)
    assert sim.holds(Atom("handhome", ()))
    assert sim.holds(Atom("asbegun", ())) == counts
    assert np.array_equal(np.append(sim.data.qpos, sim.data.qvel), start) == counts


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
def test_every_variant_of_a_seed_begins_its_execution_alike(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
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
        assert now["step"] == [NO_CLOCK if task.idles else 0]
        first = first or now
        for part, value in now.items():
            np.testing.assert_array_equal(value, first[part], err_msg=f"{part} of variant {variant}")
    env.close()


def test_a_hidden_thing_is_out_of_sight_and_the_rest_is_as_it_was() -> None:
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
