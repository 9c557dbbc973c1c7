"""Experts solve the tasks of both suites in order and smoothly, recover from disturbances, and play whole prompts."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.constants import EXECUTION, HORIZON
from lerobot_memobench.datasets.generate import HOLD_FRAMES, RecordingSettings, compiled_episode, record
from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.fixtures import close_drawer, open_drawer
from lerobot_memobench.experts.grasping import pick, put_on
from lerobot_memobench.experts.hand import OPEN, Hand
from lerobot_memobench.experts.travel import PRESS_STEPS, Held
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom, parse_formula
from lerobot_memobench.tasks.task import Task, horizon_of
from tests.support.libero import simulate

STOVE = "turn_on_the_stove_and_turn_it_off"
DRAWER = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
BOWL = "put_the_butter_into_the_bowl_from_the_prompt_video"
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
MICROWAVE = "open_and_close_the_microwave"
FIRST_FOUR = (STOVE, DRAWER, BOWL, ASSEMBLY)
SMOOTH = 0.25
"""Largest change of an action's component from one step to the next."""


def play(
    task: Task,
    seed: int,
    *,
    prompt: bool = False,
    referent: str = "fixed",
    disturb: Callable[[Episode, np.ndarray], np.ndarray] = lambda _, action: action,
    horizon: int = HORIZON,
) -> Episode:
    """Run the expert until the episode ends, and check success, order, prompt and actions."""
    episode = Episode(task, demonstration_prompt=prompt, referent=referent, horizon=horizon)
    episode.reset(seed)
    actions = []
    while not episode.done:
        action = episode.expert_action()
        if episode.phase == EXECUTION:
            actions.append(action)
        episode.step(disturb(episode, action))
    assert episode.success, f"{task.name}, seed {seed}: no success in {episode.exec_steps} steps"
    assert None not in episode.progress.ordered_step, f"{task.name}, seed {seed}"
    assert episode.prompt_shown is not False, f"{task.name}, seed {seed}"
    assert np.abs(actions).max() <= 1.0
    assert np.abs(np.diff(np.array(actions)[:, :6], axis=0)).max() <= SMOOTH
    return episode


def with_goal(name: str, goal: list[object]) -> Task:
    """Return a custom task: the scene of another task, a goal, no checkpoints."""
    return dataclasses.replace(get_task(name), goal=parse_formula(goal), checkpoints=())


def test_solves_in_order_and_smoothly() -> None:
    play(get_task(BOWL), 10_002)


def test_solves_a_custom_task() -> None:
    bowl = ["on", "akita_black_bowl_1", "wooden_cabinet_1_top_side"]
    goal = ["and", ["close", "wooden_cabinet_1_middle_region"], bowl]
    play(with_goal("check_the_middle_drawer_of_the_cabinet", goal), 10_000)


def test_a_slipped_handle_is_grasped_again() -> None:
    task, left = get_task("check_the_top_drawer_of_the_cabinet"), 12

    def slip(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal left
        _, q = episode.sim.world.articulation("wooden_cabinet_1_top_region")
        if left and q < -0.07 and action[6] > 0:
            left -= 1
            return np.array([0.0, 0.4, 0.4, 0.0, 0.0, 0.0, -1.0])
        return action

    play(task, 10_000, disturb=slip)
    assert left == 0


def test_doors_are_pushed_against_their_stop() -> None:
    """A less exact policy that stops some steps earlier still closes the joint."""
    shut, moved, pressed = Atom("close", ("microwave_1",)), False, 0

    def look(episode: Episode, action: np.ndarray) -> np.ndarray:
        nonlocal moved, pressed
        moved = moved or not episode.sim.holds(shut)
        pressed += bool(moved and episode.sim.holds(shut) and action[6] > 0 and np.abs(action[:6]).max() > 0.05)
        return action

    episode = play(get_task(MICROWAVE), 20_000, disturb=look)
    for _ in range(HOLD_FRAMES):
        episode.step(look(episode, episode.expert_action()))
    assert pressed >= PRESS_STEPS


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
    for seed in (
        (*range(10_000, 10_020), *range(7, 17)) if name in FIRST_FOUR else (*range(10_000, 10_003), 7, 8, 20_000)
    ):
        play(get_task(name), seed)


@pytest.mark.slow
@pytest.mark.parametrize("referent", ["fixed", "random"])
@pytest.mark.parametrize("name", task_names("object") + task_names("procedural"))
def test_shows_every_prompt(name: str, referent: str) -> None:
    play(get_task(name), 10_000, prompt=True, referent=referent)


# --- the blind routine ---


LIT = Atom("turnon", ("flat_stove_1",))


def test_published_task_is_done_and_begun_again() -> None:
    episode = Episode(get_task(STOVE))
    episode.reset(20_001)
    lit, turned_on, succeeded = False, 0, False
    for _ in range(600):
        episode.step(episode.blind_action())
        succeeded = succeeded or episode.success
        before, lit = lit, episode.sim.holds(LIT)
        turned_on += lit and not before
        if turned_on > 1:
            break
    assert succeeded
    assert turned_on > 1, "it goes on after the goal has come true"


# --- strict tasks ---

BLACK_BOWL = "check_the_middle_drawer_once_then_put_the_black_bowl_in_the_top_drawer"
DRAWERS = "check_all_three_drawers_once_each_in_the_given_order"
CHARGER = "find_the_charger_hidden_in_one_of_the_drawers"
ARTICHOKE = "find_the_artichoke_hidden_in_one_of_the_drawers"
BROCCOLI = "find_the_broccoli_hidden_in_one_of_the_drawers"
TOMATO = "find_the_tomato_hidden_in_one_of_the_drawers"
MILK = "put_only_the_milk_pointed_out_in_the_prompt_video_on_the_plate"
SPROUTS = "find_the_brussels_sprouts_hidden_in_one_of_the_drawers"
SWAP = "swap_the_objects_strictly_in_the_sequence_shown_in_the_prompt_video"
BUTTER = "put_the_butter_only_into_the_bowl_from_the_prompt_video"
CLEAR = "clear_and_serve_strictly_as_demonstrated_in_the_prompt_video"
WASTE = "discard_and_plate_strictly_as_demonstrated_in_the_prompt_video"


def run(sim: Simulation, motion: Iterator[NDArray[np.float32]]) -> int:
    """Execute a motion and return its number of control steps."""
    steps = 0
    for action in motion:
        sim.step(action)
        steps += 1
    return steps


def test_solves_a_strict_task_with_its_prompt() -> None:
    play(get_task(CHARGER).variant(2), 20_000, prompt=True)


FAILED_ONCE = {
    "fixed": [
        (BLACK_BOWL, 10_027),  # the grasp tipped the bowl
        (WASTE, 20_043),  # the prompt ended too early
        (WASTE, 10_016),  # the prompt was cut because the flange met a carton again and again
    ],
    # The hand slipped off a bar or off butter at the limit of reach, met what stands in front of a drawer, or carried
    # the milk carton up.
    "random": [
        (DRAWERS, 20_003),
        (ARTICHOKE, 20_009),
        (BROCCOLI, 20_008),
        (TOMATO, 20_000),
        (WASTE, 20_001),
        (WASTE, 20_002),
        (WASTE, 20_023),
        (SPROUTS, 20_102),
        (SWAP, 20_102),
        (BROCCOLI, 20_204),
        (ARTICHOKE, 20_206),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed", "referent"), [(*each, referent) for referent, seeds in FAILED_ONCE.items() for each in seeds]
)
def test_solves_seeds_that_once_failed(name: str, seed: int, referent: str) -> None:
    play(get_task(name), seed, prompt=True, referent=referent)


@pytest.mark.slow
def test_takes_an_unreachable_low_grasp_once() -> None:
    """The carton stands behind a bottle."""
    assert play(get_task(MILK), 20_034, prompt=True).exec_steps < 500


def test_opens_the_lowest_drawer_without_touching_the_table() -> None:
    """With more roll the hand rests on the table above the bar, slips off, and needs 500 steps."""
    sim = simulate(DRAWERS)
    sim.reset(20_000)
    region = "wooden_cabinet_1_bottom_region"
    steps = run(sim, open_drawer(Hand(sim, np.random.default_rng(20_000)), region))
    assert sim.holds(Atom("open", (region,)))
    assert steps < 200


def test_grasps_a_flat_box_beside_a_tall_one() -> None:
    """In the middle of the butter the palm meets the carton: two attempts of 230 steps, and the carton falls."""
    sim = simulate(WASTE)
    sim.reset(20_012)
    (carton, _), (bowl, _) = sim.asset_pose("milk_1"), sim.asset_pose("bowl_1")
    steps = run(sim, pick(Hand(sim, np.random.default_rng(0)), "butter_1", place=bowl))
    assert sim.asset_pose("butter_1")[0][2] > 0.95
    assert steps < 130
    assert np.linalg.norm(sim.asset_pose("milk_1")[0] - carton) < 0.005


def test_a_push_aside_is_corrected_before_the_release() -> None:
    """A push of 6 cm that also lifts the hand ended the descent as if the bowl carried the butter."""
    sim = simulate(BUTTER)
    sim.reset(20_203)
    hand, goal = Hand(sim, np.random.default_rng(0)), Atom("on", ("butter_1", "bowl_mid"))
    picking = pick(hand, "butter_1", place=sim.asset_pose("bowl_mid")[0])
    held: Held | None = None
    try:
        while True:
            sim.step(next(picking))
    except StopIteration as end:
        held = end.value
    assert held is not None
    pushed = 0
    for action in put_on(hand, held, "bowl_mid"):
        below = sim.asset_pose("butter_1")[0] - sim.asset_pose("bowl_mid")[0]
        if pushed < 4 and (pushed or (below[2] < 0.11 and np.hypot(*below[:2]) < 0.02)):
            action[:3] += np.array([0.0, 1.45, 0.5], np.float32)
            pushed += 1
        sim.step(np.clip(action, -1, 1))
    run(sim, hand.wait(20, OPEN))
    assert pushed == 4
    assert sim.holds(goal)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), [(BUTTER, 20_203), (CLEAR, 20_204), (WASTE, 20_206)])
def test_solves_perturbed_seeds_that_once_failed(name: str, seed: int) -> None:
    """A push moved the hand aside while it set an object down, which was then released over the rim of the bowl."""
    settings = RecordingSettings(referent="drawn", images=False, perturb=True)
    assert record(compiled_episode(get_task(name), settings), seed, settings, lambda images: None).success


def test_opens_a_drawer_behind_a_bottle() -> None:
    """Rolled the other way, the hand meets the bottle and never reaches the handle."""
    sim = simulate(ARTICHOKE)
    sim.reset(20_206)
    region = "wooden_cabinet_1_middle_region"
    assert run(sim, open_drawer(Hand(sim, np.random.default_rng(0)), region)) < 160
    assert sim.holds(Atom("open", (region,)))


def test_closes_a_drawer_beside_a_bottle() -> None:
    """In front of the handle's middle the palm meets the bottle, which a motion has moved there."""
    sim = simulate(SPROUTS)
    sim.reset(20_102)
    region = "wooden_cabinet_1_bottom_region"
    part, _ = sim.world.articulation(region)
    sim.data.joint(part.joint).qpos[0] = part.open_q
    bottle = sim.model.joint(int(sim.model.body("bottle_of_protein_powder__2_1").jntadr[0])).id
    sim.data.joint(bottle).qpos[:2] = 0.107, 0.055
    sim.step(NO_OP)
    assert run(sim, close_drawer(Hand(sim, np.random.default_rng(0)), region)) < 160
    assert sim.holds(Atom("close", (region,)))


@pytest.mark.usefixtures("short_holds")
def test_visits_home_between_events() -> None:
    episode = Episode(get_task("check_the_top_drawer_a_given_number_of_times").variant(1))
    episode.reset(20_000)
    home = Atom("handhome", ())
    visits, longest, now = 0, 0, 0
    while episode.progress.index < 3:  # two events done
        episode.step(episode.expert_action())
        there = episode.phase == EXECUTION and episode.sim.holds(home)
        visits += there and not now
        now = now + 1 if there else 0
        longest = max(longest, now)
    assert visits >= 2
    assert longest < 40


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", task_names(suite="strict"))
def test_solves_every_variant(name: str) -> None:
    base = get_task(name)
    horizon = horizon_of("extreme")  # the largest counts
    for k in range(base.num_variants):
        play(base.variant(k), 20_000 + k, prompt=True, horizon=horizon)
