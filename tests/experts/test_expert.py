"""Experts solve the tasks in order and smoothly, and recover from disturbances."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lerobot_memobench.datasets.recording import HOLD_FRAMES
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.expert import Expert, hold_steps_of, steps_of
from lerobot_memobench.experts.grasping import grasp_pose
from lerobot_memobench.experts.hand import EMPTY_OPENING, Hand
from lerobot_memobench.experts.travel import OPEN_WIDTH, PRESS_STEPS, protrudes_from_drawer
from lerobot_memobench.protocol import EXECUTION
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import And, Atom, Then, parse_formula
from lerobot_memobench.tasks.progress import HOLD_STEPS
from lerobot_memobench.tasks.task import Task

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
BOWL = "put_the_butter_into_the_bowl_from_the_prompt_video"
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
MICROWAVE = "open_and_close_the_microwave"
FIRST_FOUR = (STOVE, DRAWER, BOWL, ASSEMBLY)
SMOOTH = 0.25
"""Largest change of an action's component from one step to the next."""


@dataclass
class Played:
    """Result of an episode."""

    episode: Episode
    actions: np.ndarray
    """Actions of the execution, (T, 7)."""
    faults: list[str] = field(default_factory=list)


def play(
    task: Task,
    seed: int,
    *,
    prompt: bool = False,
    referent: str = "fixed",
    disturb: Callable[[Episode, np.ndarray], np.ndarray] | None = None,
) -> Played:
    """Run the expert until the episode ends; collect faults."""
    episode = Episode(task, demonstration_prompt=prompt, referent=referent)
    episode.reset(seed)
    actions = []
    while not episode.done:
        action = episode.expert_action()
        if episode.phase == EXECUTION:
            actions.append(action)
        episode.step(action if disturb is None else disturb(episode, action))
    played = Played(episode, np.array(actions))
    if not episode.success:
        played.faults.append(f"no success in {episode.exec_steps} steps")
    order = episode.progress.ordered_step
    if None in order:
        played.faults.append(f"checkpoints not completed in order: {order}")
    if episode.prompt_shown is False:
        played.faults.append("the prompt was incomplete")
    if np.abs(played.actions).max() > 1.0:
        played.faults.append("an action outside [-1, 1]")
    jump = np.abs(np.diff(played.actions[:, :6], axis=0)).max()
    if jump > SMOOTH:
        played.faults.append(f"an action jumps by {jump:.2f}")
    return played


def sweep(tasks: list[Task], seeds: Iterable[int], **settings: object) -> dict[str, list[str]]:
    """Play every task on every seed; return the faults by task and seed, of those that have any."""
    faults = {}
    for task in tasks:
        for seed in seeds:
            found = play(task, seed, **settings).faults  # type: ignore[arg-type]
            if found:
                faults[f"{task.name} {seed}"] = found
    return faults


def with_goal(name: str, goal: list[object]) -> Task:
    """Return a custom task: the scene of another task, a goal, no checkpoints."""
    return dataclasses.replace(get_task(name), goal=parse_formula(goal), checkpoints=())


@pytest.mark.parametrize(
    ("formula", "expected"),
    [
        (["then", ["on", "a", "b"], ["and", ["not", ["on", "c", "b"]], ["close", "d"]]], ["on a b", "close d"]),
        (["or", ["on", "a", "b"], ["on", "a", "c"]], ["on a b"]),
        (["and", ["wasturnedon", "s"], ["in", "x", "y"]], ["wasturnedon s", "in x y"]),
        (["when", ["handhome"], ["exactly", 2, ["open", "d"]]], ["open d", "handhome"]),
    ],
)
def test_steps_of_a_formula(formula: list[object], expected: list[str]) -> None:
    assert [" ".join((atom.predicate, *atom.args)) for atom in steps_of(parse_formula(formula))] == expected


def test_hold_steps_of_nested_orders_add_up() -> None:
    first, second = Atom("close", ("a",)), Atom("close", ("b",))
    assert hold_steps_of(And((first, second))) == 0
    assert hold_steps_of(Then((first, second))) == HOLD_STEPS
    assert hold_steps_of(Then((first, And((Then((first, second)), second))))) == 2 * HOLD_STEPS


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        (BOWL, 10_002),
        pytest.param(STOVE, 7, marks=pytest.mark.slow),
        pytest.param(DRAWER, 10_001, marks=pytest.mark.slow),
        pytest.param(ASSEMBLY, 8, marks=pytest.mark.slow),
        pytest.param(MICROWAVE, 9, marks=pytest.mark.slow),
    ],
)
def test_solves_in_order_and_smoothly(name: str, seed: int) -> None:
    assert not play(get_task(name), seed).faults


@pytest.mark.slow
def test_prompt_points_at_the_random_referent() -> None:
    name = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
    played = play(get_task(name), 10_000, prompt=True, referent="random")
    assert not played.faults
    assert played.episode.prompt_shown


def test_solves_a_custom_task() -> None:
    goal = [
        "and",
        ["close", "wooden_cabinet_1_middle_region"],
        ["on", "akita_black_bowl_1", "wooden_cabinet_1_top_side"],
    ]
    own = with_goal("check_the_middle_drawer_of_the_cabinet", goal)
    assert not play(own, 10_000).faults


@pytest.mark.parametrize(
    ("name", "thing", "state", "goal"),
    [
        pytest.param(
            MICROWAVE, "microwave_1", "open", "close", id="door beyond the upright hand's reach", marks=pytest.mark.slow
        ),
        pytest.param(DRAWER, "wooden_cabinet_1_bottom_region", "open", "close", id="drawer"),
        pytest.param(STOVE, "flat_stove_1", "turnon", "turnoff", id="stove"),
    ],
)
def test_reverts_initial_joint_states(name: str, thing: str, state: str, goal: str) -> None:
    published = with_goal(name, [goal, thing])
    init = (*(atom for atom in published.init if atom.args != (thing,)), Atom(state, (thing,)))
    played = play(dataclasses.replace(published, init=init), 8)
    assert not played.faults
    assert played.episode.exec_steps > 20


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param("open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate", 10_025, id="thrown door"),
        pytest.param(
            "put_the_tomato_into_the_top_drawer_and_the_biscuit_into_the_middle_drawer",
            10_038,
            id="distant biscuit",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_solves_seeds_that_once_failed(name: str, seed: int) -> None:
    assert not play(get_task(name), seed).faults


@pytest.mark.parametrize(("name", "kind", "room"), [(BOWL, "akita_black_bowl", 0.012), (SWAP, "plate", 0.004)])
def test_a_rim_is_grasped_with_a_gap(name: str, kind: str, room: float) -> None:
    """A policy trained with 4 mm at a deep bowl hit every second rim (19 of 50; with 12 mm 20 of 20 succeeded)."""
    episode = Episode(get_task(name), demonstration_prompt=False)
    episode.reset(20_000)
    thing, asset = next(item for item in episode.sim.assets.items() if item[1].class_name == kind)
    (grasp,) = asset.grasps
    target, _ = grasp_pose(Hand(episode.sim, np.random.default_rng(0)), thing, grasp, 0.0, OPEN_WIDTH)
    off = np.linalg.norm(target[:2] - episode.sim.body_pose(thing)[0][:2])
    inner = off + grasp.width / 2 - OPEN_WIDTH / 2
    assert grasp.position[0] - inner == pytest.approx(room, abs=1e-3)


def test_a_dropped_object_is_picked_up_again() -> None:
    left = 15

    def let_go(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        if left and episode.sim.body_pose("butter_1")[0][2] > 0.96:
            left -= 1
            return np.append(action[:6], -1.0)
        return action

    assert not play(get_task(BOWL), 10_000, disturb=let_go).faults
    assert left == 0


def test_a_leaning_bowl_is_placed_again() -> None:
    """A bowl that protrudes from its drawer, seen once in a thousand episodes, blocks it."""
    task = get_task("check_the_middle_drawer_and_put_the_black_bowl_in_the_top_drawer_and_close_it")
    bowl, drawer = "akita_black_bowl_1", "wooden_cabinet_1_top_region"
    place = np.array([-0.0681, -0.0323, -0.0159])
    turn = np.array([[-0.9705, 0.0509, 0.2356], [0.0136, -0.9644, 0.2641], [0.2406, 0.2595, 0.9353]])
    leans = 0

    def lean(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal leans
        sim = episode.sim
        (x, y, z), _ = sim.body_pose(bowl)
        released = sim.holds(Atom("in", (bowl, drawer))) and np.linalg.norm(sim.eef_pose()[0] - (x, y, z)) > 0.1
        if released and not leans:
            leans += 1
            centre, rotation = sim.site_pose(drawer)
            quaternion = Rotation.from_matrix(rotation @ turn).as_quat(scalar_first=True)
            joint = sim.data.joint(sim.model.body(bowl).jntadr[0])
            joint.qpos = np.concatenate([centre + rotation @ place, quaternion])
            joint.qvel = 0.0
            mujoco.mj_forward(sim.model, sim.data)
            assert protrudes_from_drawer(Hand(sim, np.random.default_rng(0)), bowl, drawer)
        return action

    assert not play(task, 10_000, disturb=lean).faults
    assert leans == 1


@pytest.mark.slow
def test_bowl_pushed_up_over_its_drawer() -> None:
    """A bowl released 13 cm too high lands on its side, where it can hardly be grasped."""
    bowl, drawer = "akita_black_bowl_1", "wooden_cabinet_1_top_region"
    left, heights = 12, []

    def push(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        over = episode.sim.body_pose(bowl)[0] - episode.sim.site_pose(drawer)[0]
        if left and action[6] > 0 and np.hypot(*over[:2]) < 0.03 and over[2] < 0.1:
            left -= 1
            return np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0])
        if left < 12 and action[6] < 0:
            heights.append(over[2])
        return action

    task = get_task("check_the_middle_drawer_and_put_the_black_bowl_in_the_top_drawer_and_close_it")
    assert not play(task, 10_000, disturb=push).faults
    assert heights[0] < 0.03


@pytest.mark.parametrize(
    ("task", "left"),
    [
        (get_task("check_the_top_drawer_of_the_cabinet"), 12),
        pytest.param(get_task("check_the_top_drawer_a_given_number_of_times").variant(0), 80, marks=pytest.mark.slow),
    ],
)
def test_a_slipped_handle_is_grasped_again(task: Task, left: int) -> None:
    """Counting tasks retry until the handle is grasped."""

    def slip(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        _, q = episode.sim.world.articulation("wooden_cabinet_1_top_region")
        if left and q < -0.07 and action[6] > 0:
            left -= 1
            return np.array([0.0, 0.4, 0.4, 0.0, 0.0, 0.0, -1.0])
        return action

    assert not play(task, 10_000, disturb=slip).faults
    assert left == 0


def test_a_missed_grasp_is_retried_at_once() -> None:
    """Empty fingers return to the object without a lift."""
    left, lowest, highest = 8, np.inf, 0.0

    def miss(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left, lowest, highest
        if left and action[6] > 0:
            left -= 1
            return np.array([0.0, 0.0, 0.8, 0.0, 0.0, 0.0, 1.0])
        if not left and episode.sim.gripper_opening() <= EMPTY_OPENING and action[6] > 0:
            height = episode.sim.eef_pose()[0][2]
            lowest, highest = min(lowest, height), max(highest, height)
        return action

    assert not play(get_task(BOWL), 10_000, disturb=miss).faults
    assert left == 0
    assert 0 < highest - lowest < 0.05


@pytest.mark.parametrize(
    ("name", "shut"),
    [
        (STOVE, Atom("turnoff", ("flat_stove_1",))),
        (MICROWAVE, Atom("close", ("microwave_1",))),
        ("check_the_top_drawer_of_the_cabinet", Atom("close", ("wooden_cabinet_1_top_region",))),
    ],
)
def test_joints_are_pushed_against_their_stop(name: str, shut: Atom) -> None:
    """A less exact policy that stops some steps earlier still closes the joint."""
    moved, pressed = False, 0

    def look(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal moved, pressed
        moved = moved or not episode.sim.holds(shut)
        pressed += bool(moved and episode.sim.holds(shut) and action[6] > 0 and np.abs(action[:6]).max() > 0.05)
        return action

    played = play(get_task(name), 20_000, disturb=look)
    assert not played.faults
    for _ in range(HOLD_FRAMES):
        played.episode.step(look(played.episode, played.episode.expert_action()))
    assert pressed >= PRESS_STEPS


@pytest.mark.parametrize("name", [pytest.param(SWAP, marks=pytest.mark.slow), MILK])
def test_stopped_fingers_close_soon(name: str) -> None:
    """On a carton's top, or a plate's rim: a policy without memory cannot learn a longer wait."""
    still, waits = 0, [0]
    last = np.full(8, np.inf)

    def look(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal still, last
        now = episode.sim.proprio()
        still = still + 1 if action[6] < 0 and np.abs(now - last)[:3].max() < 8e-4 else 0
        waits.append(still)
        last = now
        return action

    assert not play(get_task(name), 20_000, referent="random", disturb=look).faults
    assert max(waits) <= 10


def test_seeds_differ_and_repeat() -> None:
    task = get_task(STOVE)
    first, again, other = (play(task, seed).actions for seed in (10_000, 10_000, 10_001))
    np.testing.assert_array_equal(first, again)
    length = min(len(first), len(other))
    assert np.abs(first[:length] - other[:length]).max() > 0.05


@pytest.mark.slow
def test_prompt_is_not_repeated() -> None:
    """A completed order is not repeated although its first atom no longer holds."""
    episode = Episode(get_task(SWAP), demonstration_prompt=True)
    episode.reset(10_041)
    while episode.phase != EXECUTION:
        episode.step(episode.expert_action())
    assert episode.prompt_shown
    assert episode.step_index < 800


def test_rests_after_its_plan() -> None:
    task = get_task(STOVE)
    episode = play(task, 10_000).episode
    for _ in range(80):
        action = episode.expert_action()
        episode.step(action)
    np.testing.assert_array_equal(action, [0, 0, 0, 0, 0, 0, -1])
    assert episode.success


def test_goal_without_a_motion_is_an_error() -> None:
    task = with_goal(STOVE, ["in", "moka_pot_1", "flat_stove_1_cook_region"])
    sim = Simulation(task)
    sim.reset(10_000)
    with pytest.raises(MemobenchError, match="flat_stove_1_cook_region"):
        Expert(task, sim, np.random.default_rng(0)).act()


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", task_names())
def test_solves_every_task(name: str) -> None:
    seeds = (*range(10_000, 10_020), *range(7, 17)) if name in FIRST_FOUR else (*range(10_000, 10_003), 7, 8)
    assert not sweep([get_task(name)], seeds)


@pytest.mark.slow
@pytest.mark.parametrize("referent", ["fixed", "random"])
@pytest.mark.parametrize("name", task_names("object") + task_names("procedural"))
def test_shows_every_prompt(name: str, referent: str) -> None:
    assert not sweep([get_task(name)], range(10_000, 10_002), prompt=True, referent=referent)
