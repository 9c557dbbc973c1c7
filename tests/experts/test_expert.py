"""Experts solve the tasks, in order, smoothly, and get over mishaps."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
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
from lerobot_memobench.tasks.formula import And, Atom, Then, atoms, parse_formula
from lerobot_memobench.tasks.progress import HOLD_STEPS
from lerobot_memobench.tasks.task import Task

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
BOWL = "put_the_butter_into_the_bowl_from_the_prompt_video"
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"
MICROWAVE = "open_and_close_the_microwave"
SMOOTH = 0.25
"""Largest change of an action's component from one step to the next."""


@dataclass
class Played:
    """What came of an episode."""

    episode: Episode
    actions: np.ndarray
    """Of the execution, (T, 7)."""
    faults: list[str] = field(default_factory=list)


def play(
    task: Task,
    seed: int,
    *,
    prompt: bool = False,
    referent: str = "fixed",
    disturb: Callable[[Episode, np.ndarray], np.ndarray] | None = None,
) -> Played:
    """Let the expert act until the episode ends; note whatever is not as it must be."""
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
        played.faults.append("the prompt did not show what it had to")
    if np.abs(played.actions).max() > 1.0:
        played.faults.append("an action outside [-1, 1]")
    jump = np.abs(np.diff(played.actions[:, :6], axis=0)).max()
    if jump > SMOOTH:
        played.faults.append(f"an action jumps by {jump:.2f}")
    return played


def sweep(tasks: list[Task], seeds: range, **settings: object) -> dict[str, list[str]]:
    """Play every task on every seed; return the faults by task and seed, of those that have any."""
    faults = {}
    for task in tasks:
        for seed in seeds:
            found = play(task, seed, **settings).faults  # type: ignore[arg-type]
            if found:
                faults[f"{task.name} {seed}"] = found
    return faults


def with_goal(name: str, goal: list[object]) -> Task:
    """Return a task of one's own: the scene of another, a goal, no checkpoints."""
    return dataclasses.replace(get_task(name), goal=parse_formula(goal), checkpoints=())


def test_steps_are_the_atoms_in_order_without_what_must_not_be() -> None:
    formula = parse_formula(
        ["then", ["on", "a", "b"], ["and", ["not", ["on", "c", "b"]], ["close", "d"], ["then", ["wasopen", "e"]]]]
    )
    assert steps_of(formula) == [Atom("on", ("a", "b")), Atom("close", ("d",)), Atom("wasopen", ("e",))]


def test_of_alternatives_the_first_is_done() -> None:
    formula = parse_formula(["or", ["on", "a", "b"], ["on", "a", "c"]])
    assert steps_of(formula) == [Atom("on", ("a", "b"))]


def test_a_formula_without_negation_or_choice_is_done_whole() -> None:
    formula = parse_formula(["and", ["wasturnedon", "s"], ["turnoff", "s"], ["in", "x", "y"]])
    assert steps_of(formula) == list(atoms(formula))


@pytest.mark.parametrize(
    ("name", "seed"),
    [(STOVE, 7), (DRAWER, 10_001), (BOWL, 10_002), (ASSEMBLY, 8), pytest.param(MICROWAVE, 9, marks=pytest.mark.slow)],
)
def test_solves_in_order_and_smoothly(name: str, seed: int) -> None:
    assert not play(get_task(name), seed).faults


def test_prompt_points_at_the_random_referent() -> None:
    name = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
    played = play(get_task(name), 10_000, prompt=True, referent="random")
    assert not played.faults
    assert played.episode.prompt_shown


def test_a_task_of_ones_own_needs_no_code() -> None:
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
        pytest.param(MICROWAVE, "microwave_1", "open", "close", id="door wide open, beyond the upright hand's reach"),
        pytest.param(DRAWER, "wooden_cabinet_1_bottom_region", "open", "close", id="drawer"),
        pytest.param(STOVE, "flat_stove_1", "turnon", "turnoff", id="stove"),
    ],
)
def test_undoes_what_the_scene_starts_with(name: str, thing: str, state: str, goal: str) -> None:
    published = with_goal(name, [goal, thing])
    init = (*(atom for atom in published.init if atom.args != (thing,)), Atom(state, (thing,)))
    played = play(dataclasses.replace(published, init=init), 8)
    assert not played.faults
    assert played.episode.exec_steps > 20


def test_a_door_that_was_opened_fast_stays_in_reach() -> None:
    # The fastest of the demonstrations: it threw the door on, past the place where the hand can take it again.
    assert not play(get_task("open_and_close_the_microwave_and_put_the_white_bowl_on_the_plate"), 10_025).faults


def test_a_far_thing_is_held_where_the_arm_reaches() -> None:
    # Turned the easy way, the hand stayed 2 cm short of the biscuit, closed on its edge, and it slipped out of reach.
    task = get_task("put_the_tomato_into_the_top_drawer_and_the_biscuit_into_the_middle_drawer")
    assert not play(task, 10_038).faults


@pytest.mark.parametrize(("name", "kind", "room"), [(BOWL, "akita_black_bowl", 0.012), (SWAP, "plate", 0.004)])
def test_a_rim_is_taken_with_room_beside_it(name: str, kind: str, room: float) -> None:
    """A policy that saw 4 mm in a deep bowl came down on every second rim (19 of 50; with 12 mm 20 of 20)."""
    episode = Episode(get_task(name), demonstration_prompt=False)
    episode.reset(20_000)
    thing, asset = next(item for item in episode.sim.assets.items() if item[1].class_name == kind)
    (grasp,) = asset.grasps
    target, _ = grasp_pose(Hand(episode.sim, np.random.default_rng(0)), thing, grasp, 0.0, OPEN_WIDTH)
    off = np.linalg.norm(target[:2] - episode.sim.body_pose(thing)[0][:2])
    inner = off + grasp.width / 2 - OPEN_WIDTH / 2
    assert grasp.position[0] - inner == pytest.approx(room, abs=1e-3)


def test_what_was_dropped_is_picked_up_again() -> None:
    left = 15

    def let_go(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        if left and episode.sim.body_pose("butter_1")[0][2] > 0.96:
            left -= 1
            return np.append(action[:6], -1.0)
        return action

    assert not play(get_task(BOWL), 10_000, disturb=let_go).faults
    assert left == 0


def test_what_leans_in_a_drawer_is_laid_down_again() -> None:
    """A bowl that stands out of its drawer, as one came to do in a thousand episodes, keeps it from being shut."""
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
def test_what_is_pushed_up_over_its_drawer_is_not_dropped() -> None:
    """A bowl let go of 13 cm too high had come to stand on its side, where it can hardly be taken."""
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
def test_a_handle_that_slipped_is_taken_again(task: Task, left: int) -> None:
    """As often as it takes, where going on would spoil a count."""

    def slip(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        _, q = episode.sim.world.articulation("wooden_cabinet_1_top_region")
        if left and q < -0.07 and action[6] > 0:
            left -= 1
            return np.array([0.0, 0.4, 0.4, 0.0, 0.0, 0.0, -1.0])
        return action

    assert not play(task, 10_000, disturb=slip).faults
    assert left == 0


def test_a_miss_is_seen_at_once() -> None:
    """Fingers that met go back to where the thing is, and lift nothing first."""
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
def test_what_has_a_stop_is_pushed_on_against_it(name: str, shut: Atom) -> None:
    """Who sees it less exactly ends some steps earlier, and has it shut all the same."""
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


@pytest.mark.parametrize("name", [SWAP, MILK])
def test_fingers_that_are_stopped_close(name: str) -> None:
    """On a carton's top, or a plate's rim: a policy without a memory of it could not learn how long to wait there."""
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


def test_a_prompt_ends_with_what_it_shows() -> None:
    """An order that was followed is not gone through again: what it began with no longer holds."""
    episode = Episode(get_task(SWAP), demonstration_prompt=True)
    episode.reset(10_041)
    while episode.phase != EXECUTION:
        episode.step(episode.expert_action())
    assert episode.prompt_shown
    assert episode.step_index < 800


def test_an_order_within_an_order_is_waited_for_twice() -> None:
    first, second = Atom("close", ("a",)), Atom("close", ("b",))
    assert hold_steps_of(And((first, second))) == 0
    assert hold_steps_of(Then((first, second))) == HOLD_STEPS
    assert hold_steps_of(Then((first, And((Then((first, second)), second))))) == 2 * HOLD_STEPS


def test_rests_once_its_plan_is_through() -> None:
    task = get_task(STOVE)
    episode = play(task, 10_000).episode
    for _ in range(80):
        action = episode.expert_action()
        episode.step(action)
    np.testing.assert_array_equal(action, [0, 0, 0, 0, 0, 0, -1])
    assert episode.success


def test_says_which_goal_it_cannot_bring_about() -> None:
    own = with_goal(STOVE, ["in", "moka_pot_1", "flat_stove_1_cook_region"])
    sim = Simulation(own)
    sim.reset(10_000)
    expert = Expert(own, sim, np.random.default_rng(0))
    with pytest.raises(MemobenchError, match="flat_stove_1_cook_region"):
        expert.act()


@pytest.mark.slow
@pytest.mark.parametrize("name", [STOVE, DRAWER, BOWL, ASSEMBLY])
def test_never_fails_on_the_first_four(name: str) -> None:
    task = get_task(name)
    assert not sweep([task], range(10_000, 10_020)) | sweep([task], range(7, 17))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", task_names())
def test_solves_every_task(name: str) -> None:
    assert not sweep([get_task(name)], range(10_000, 10_003)) | sweep([get_task(name)], range(7, 9))


@pytest.mark.slow
@pytest.mark.parametrize("referent", ["fixed", "random"])
@pytest.mark.parametrize("name", task_names("object") + task_names("procedural"))
def test_shows_every_prompt(name: str, referent: str) -> None:
    assert not sweep([get_task(name)], range(10_000, 10_002), prompt=True, referent=referent)
