"""Strict scenes keep no trace, bit for bit, of past events, of hidden objects and of the variant.

- After an event, with the hand at home, the observation equals that of the first execution frame.
- The first execution frame is the same for all variants of a seed, and so are all others until a drawer that hides
  something opens.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.constants import NO_CLOCK, PROMPT
from lerobot_memobench.envs import episode as episode_module
from lerobot_memobench.envs.env import MemobenchEnv
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.envs.settings import BOTH, OBJECTS, RESET
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.hand import Hand
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.object_slots import ObjectSlots, classes
from lerobot_memobench.sim.simulation import RenderSettings, Simulation
from lerobot_memobench.sim.world import PARKING_HEIGHT
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import STRICT, Task

ARM = 9
"""Number of positions, and of velocities, of arm and fingers; they come first in the state."""
UP = np.array([0, 0, 1, 0, 0, 0, -1], np.float32)
EVENTS = {
    "check_all_three_drawers_once_each_in_the_given_order": ("open", "close", "wooden_cabinet_1_bottom_region"),
    "open_and_close_the_microwave_a_given_number_of_times": ("open", "close", "microwave_1"),
    "turn_the_stove_on_and_off_a_given_number_of_times": ("turnon", "turnoff", "flat_stove_1"),
    "check_the_top_drawer_a_given_number_of_times": ("open", "close", "wooden_cabinet_1_top_region"),
    "check_the_middle_drawer_a_given_number_of_times": ("open", "close", "wooden_cabinet_1_middle_region"),
    "turn_the_stove_on_and_off_near_the_shelf_a_given_number_of_times": ("turnon", "turnoff", "flat_stove_1"),
}
DRAWER, DOOR, KNOB, *_ = EVENTS
FEW_EVENTS = [(DRAWER, 1), (KNOB, 1)]
MORE_EVENTS = [(name, 2) for name in EVENTS if name != DRAWER]


@pytest.mark.usefixtures("short_holds")
@pytest.mark.parametrize(
    ("name", "rounds"), [*FEW_EVENTS, *(pytest.param(*case, marks=pytest.mark.slow) for case in MORE_EVENTS)]
)
def test_observation_at_home_is_the_same_after_an_event(name: str, rounds: int) -> None:
    env = MemobenchEnv(name, obs_type=BOTH, prompt_in=RESET, robot_state=True)
    first, _ = env.reset(seed=20_000)
    expert = Expert(env.episode.task, env.episode.sim, np.random.default_rng(20_000))
    begin, end, thing = EVENTS[name]
    if name == DRAWER:
        thing = f"wooden_cabinet_1_{min(('top', 'middle', 'bottom'), key=env.task_description.index)}_region"
    for _ in range(rounds):
        env.need_observation(False)
        moved = False
        for atom in (Atom(begin, (thing,)), Atom(end, (thing,)), Atom("asbegun", ())):
            for action in expert.achieve(atom):
                env.step(np.clip(action, -1, 1).astype(np.float32))
            moved = moved or bool((env.episode.sim.proprio() != first["agent_pos"]).any())
        assert moved
        env.need_observation(True)
        seen, *_ = env.step(np.array([0, 0, 0, 0, 0, 0, -1], np.float32))
        for camera, image in first["pixels"].items():
            np.testing.assert_array_equal(seen["pixels"][camera], image)
        for part in set(first) - {"pixels"}:
            np.testing.assert_equal(seen[part], first[part], err_msg=part)
    env.close()


@pytest.mark.usefixtures("short_holds")
@pytest.mark.parametrize(
    ("name", "joint", "position"),
    [
        ("check_the_top_drawer_a_given_number_of_times", "wooden_cabinet_1_bottom_region", -0.012),
        (DOOR, "microwave_1", -0.2),
        (KNOB, "flat_stove_1", 0.2),
    ],
)
def test_joint_left_ajar_loses_at_home(name: str, joint: str, position: float) -> None:
    env = MemobenchEnv(name, obs_type=OBJECTS, prompt_in=RESET)
    env.reset(seed=20_000)
    sim = env.episode.sim
    for _ in range(5):
        env.step(UP)
    sim.data.qpos[sim.world.joints[joint][1]] = position
    for action in come_home(Hand(sim, np.random.default_rng(0)), *sim.home):
        if env.step(action.astype(np.float32))[2]:
            break
    assert env.episode.lost
    env.close()


@pytest.mark.parametrize(("shift", "restored"), [(0.0008, True), (0.003, False)])
def test_home_restores_a_scene_within_a_millimetre(shift: float, restored: bool) -> None:
    sim = Simulation(get_task("check_the_top_drawer_a_given_number_of_times"))
    sim.reset(20_000)
    start = np.append(sim.data.qpos, sim.data.qvel)
    for _ in range(5):
        sim.step(UP)
    sim.data.joint("akita_black_bowl_1_joint0").qpos[0] += shift
    for action in come_home(Hand(sim, np.random.default_rng(0)), *sim.home):
        sim.step(action)
    assert sim.holds(Atom("handhome", ()))
    assert sim.holds(Atom("asbegun", ())) == restored
    assert np.array_equal(np.append(sim.data.qpos, sim.data.qvel), start) == restored


# --- variants ---

HIDING, REFERENT = "find_the_tomato_hidden_in_one_of_the_drawers", "put_the_butter_into_the_bowl_from_the_prompt_video"
DRAWN = [name for name in task_names(suite=None) if get_task(name).num_variants > 1]


def fixture_joints(sim: Simulation) -> NDArray[np.float64]:
    joints = [articulation.joint for asset in sim.assets.values() for articulation in asset.articulations.values()]
    return np.array([float(sim.data.joint(joint).qpos[0]) for joint in joints])


def first_frames(
    name: str, variants: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[MemobenchEnv, dict[str, NDArray[np.generic]]]]:
    """Yield the environment at the first execution frame of each variant, and all that a policy could observe."""
    env = MemobenchEnv(name, obs_type=BOTH, referent="random", prompt_in=RESET)
    for variant in variants:

        def chosen(published: Task, seed: int, salt: str | None, *, variant: int = variant) -> Task:
            return published.variant(variant)

        monkeypatch.setattr(episode_module, "referent_of", chosen)
        seen, _ = env.reset(seed=20_003)
        assert env.episode.task.variant_index == variant
        assert env.episode.prompt_shown is not False
        sim = env.episode.sim
        arm = np.append(sim.data.qpos[:ARM], sim.data.qvel[:ARM])
        yield env, {**seen.pop("pixels"), **seen, "arm": arm, "fixtures": fixture_joints(sim)}
    env.close()


@pytest.mark.parametrize(
    ("name", "variants"),
    [
        (HIDING, (0, 1)),
        (REFERENT, (0, 1)),
        *(pytest.param(name, get_task(name).random_variants, marks=pytest.mark.slow) for name in DRAWN),
    ],
)
def test_first_execution_frame_is_the_same_for_all_variants(
    name: str, variants: tuple[int, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    first: dict[str, NDArray[np.generic]] = {}
    for env, now in first_frames(name, variants, monkeypatch):
        assert now["step"] == [NO_CLOCK if env.episode.task.suite == "strict" else 0]
        first = first or now
        for part, value in now.items():
            np.testing.assert_array_equal(value, first[part], err_msg=f"{part} of variant {env.episode.task}")
        if name == HIDING:
            check_hiding(env.episode.sim)


STROKES, STROKE_STEPS = 6, 10
"""Random displacements of a motion, and control steps for which each lasts, so that the hand meets things."""


@pytest.mark.timeout(1800)
@pytest.mark.usefixtures("short_holds")
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == HIDING else pytest.mark.slow) for name in task_names(suite=STRICT)]
)
def test_variants_are_the_same_under_random_actions_until_a_hiding_drawer_opens(name: str) -> None:
    """Physics, object slots and images, bit for bit."""
    task = get_task(name)
    prompts = [task.variant(variant).prompt for variant in range(task.num_variants)]
    hiding = {drawer for prompt in prompts if prompt is not None for _, drawer in prompt.places}
    strokes = np.random.default_rng(20_003).uniform(-1, 1, (STROKES, 7)).astype(np.float32)
    strokes[0, 2] = -1  # down to the things
    episode = Episode(task, suite=STRICT, render=RenderSettings(64, 64))
    first: list[dict[str, NDArray[np.generic]]] = []
    for variant in range(task.num_variants):
        episode.reset(20_003, variant)
        while episode.phase == PROMPT:
            episode.step(np.zeros(7, np.float32))
        sim, frames = episode.sim, []
        for action in np.repeat(strokes, STROKE_STEPS, axis=0):
            if any(sim.holds(Atom("ajar", (drawer,))) for drawer in hiding):
                break
            frames.append({**episode.images(), "state": sim.state()[1:], "slots": episode.objects()})  # without time
            episode.step(action)
        first = first or frames
        assert len(frames) == len(first) > STROKE_STEPS
        assert not np.array_equal(frames[0]["state"], frames[-1]["state"])
        for step, (now, before) in enumerate(zip(frames, first, strict=True)):
            for part, value in now.items():
                np.testing.assert_array_equal(value, before[part], err_msg=f"{part}, {variant=}, {step=}")


def check_hiding(sim: Simulation) -> None:
    """Check that the tomato is not visible and that all other objects and joints are in their initial state."""
    visible = ObjectSlots(sim).observe().reshape(SLOTS, WIDTH)
    seen = {classes()[int(row[STARTS["class"]])] for row in visible if row[STARTS["present"]]}
    assert seen
    assert "beefsteak_tomato" not in seen
    fresh = Simulation(get_task(HIDING))
    fresh.reset(20_003)
    np.testing.assert_allclose(fixture_joints(sim), fixture_joints(fresh), atol=1e-6)
    for thing in sim.task.objects:
        moved = np.linalg.norm(sim.body_pose(thing)[0] - fresh.body_pose(thing)[0])
        assert (moved > 0.05) == ("tomato" in thing), thing


# --- hidden objects ---


def begun(seed: int, variant: int) -> Episode:
    episode = Episode(get_task(HIDING), demonstration_prompt=False)
    episode.reset(seed, variant=variant, keep_prompt=True)
    while not episode.action_has_effect:
        episode.step(np.zeros(7, np.float32))
    return episode


@pytest.mark.parametrize("joints", [(1.9, -0.3, 1.9, -3.0, -0.8, 0.3, 0.9), (1.3, -0.8, 0.0, -0.7, 1.2, 3.1, 0.3)])
def test_a_wrist_camera_that_looks_up_lists_no_absent_object(joints: tuple[float, ...]) -> None:
    episode = begun(20_000, 0)
    sim, slots = episode.sim, ObjectSlots(episode.sim)
    sim.data.qpos[:7] = joints
    mujoco.mj_step1(sim.model, sim.data)
    seen = slots.observe().reshape(SLOTS, WIDTH)
    assert not (seen[:, STARTS["position"] + 2] > PARKING_HEIGHT / 2).any()
    (hidden,) = sim.absent
    rays = slots.things[next(k for k, t in enumerate(slots.things) if t.body == sim.model.body(hidden).id)]
    camera = sim.data.cam("robot0_eye_in_hand")
    direction = camera.xmat.reshape(3, 3).T @ (slots.position(rays) - camera.xpos)
    assert np.hypot(*direction[:2]) < -direction[2]  # the camera's image contains the parking place


def test_an_object_appears_at_rest_in_its_drawer_and_leaves_when_the_scene_is_restored() -> None:
    episode = begun(20_003, 0)
    (name, drawer), *_ = episode.task.prompt.places  # type: ignore[union-attr]
    expert = Expert(episode.task, episode.sim, np.random.default_rng(0))
    assert episode.sim.body_pose(name)[0][2] > PARKING_HEIGHT / 2
    assert not episode.sim.holds(Atom("in", (name, drawer)))
    for atom in (Atom("open", (drawer,)), Atom("close", (drawer,))):
        for action in expert.achieve(atom):
            episode.step(np.clip(action, -1, 1))
            if episode.sim.body_pose(name)[0][2] < PARKING_HEIGHT / 2:
                assert episode.sim.holds(Atom("in", (name, drawer)))
                assert not episode.sim.holds(Atom("lifted", (name,)))
    assert episode.sim.body_pose(name)[0][2] < PARKING_HEIGHT / 2
    for action in expert.achieve(Atom("handhome", ())):
        episode.step(np.clip(action, -1, 1))
    if episode.sim.holds(Atom("asbegun", ())):
        assert episode.sim.body_pose(name)[0][2] > PARKING_HEIGHT / 2
