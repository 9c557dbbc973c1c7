"""Episodes: drawn variants, prompt, pacing, end of the execution, failures, the authors' evaluation."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from lerobot_memobench.constants import HORIZON, PAPER, SEALED, SPLITS, VALIDATION
from lerobot_memobench.envs.episode import Episode, referent_of
from lerobot_memobench.envs.episode_log import episode_record
from lerobot_memobench.envs.pacing import STEPS_BETWEEN_PAUSES, Pacing
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom, Formula, Never, Then
from lerobot_memobench.tasks.task import STRICT, Task

STOVE = "turn_on_the_stove_and_turn_it_off"
STRICT_STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SEED = 20_000
REST = np.array([0, 0, 0, 0, 0, 0, -1], np.float32)
Policy = Callable[[Episode], NDArray[np.floating[Any]]]


def rest(episode: Episode) -> NDArray[np.float32]:
    return REST


def run(task: Task, policy: Policy = rest, seed: int = SEED, steps: int = HORIZON, **settings: Any) -> Episode:
    """Return an episode at its end, or after ``steps`` execution steps."""
    episode = Episode(task, **settings)
    episode.reset(seed)
    while not episode.done and episode.exec_steps < steps:
        episode.step(policy(episode))
    assert episode.fault is None
    return episode


# --- drawn variants ---

WITH_VARIANTS = [name for name in task_names(suite=None) if get_task(name).num_variants > 1]
FAIR = 1e-6
"""A fair draw fails a statistical check less often than this."""


@cache
def drawn(name: str, split: str, count: int = 50) -> list[int]:
    task = get_task(name)
    return [referent_of(task, SPLITS[split].start + k).variant_index for k in range(count)]


def first_of_rounds(name: str, split: str) -> list[int]:
    """Return the first variant of each balanced block, as an index from 0."""
    choices = get_task(name).random_variants
    return [choices.index(k) for k in drawn(name, split, 200)[:: len(choices)]]


def test_each_split_draws_all_variants_equally_often() -> None:
    prompted = task_names("object") + task_names("procedural")
    assert [name for name in WITH_VARIANTS if name in task_names()] == prompted
    assert referent_of(get_task(STOVE), 7) is get_task(STOVE)
    for name in WITH_VARIANTS:
        choices = get_task(name).random_variants
        for split in (PAPER, "demonstrations", VALIDATION, SEALED):
            for episodes in (4, 10, 50):
                counts = [drawn(name, split)[:episodes].count(k) for k in choices]
                assert sum(counts) == episodes, "a variant was drawn that is not admissible"
                assert max(counts) - min(counts) <= 1
        later = [referent_of(get_task(name), 20_013 + k).variant_index for k in range(9)]
        assert later == drawn(name, VALIDATION)[13:22], "the draw depends on the seed only"


def test_draws_of_rounds_splits_and_tasks_are_independent() -> None:
    def same(a: list[int], b: list[int], number: int) -> float:
        pairs = list(zip(a, b, strict=False))
        return float(stats.binomtest(sum(x == y for x, y in pairs), len(pairs), 1 / number).pvalue)

    for name in WITH_VARIANTS[::3]:
        number = len(get_task(name).random_variants)
        validation, paper = first_of_rounds(name, VALIDATION), first_of_rounds(name, PAPER)
        assert stats.chisquare([validation.count(k) for k in range(number)]).pvalue > FAIR
        assert min(same(validation, validation[period:], number) for period in range(1, 17)) > FAIR
        demonstrations = first_of_rounds(name, "demonstrations")
        assert min(same(paper[offset:], demonstrations, number) for offset in range(5)) > FAIR
    two = [name for name in WITH_VARIANTS if len(get_task(name).random_variants) == 2]
    assert min(same(a, b, 2) for a, b in pairwise(first_of_rounds(name, PAPER) for name in two)) > FAIR


def test_strict_tasks_draw_for_each_referent_and_a_variant_stays_fixed() -> None:
    for referent in ("fixed", "random"):
        assert Episode(get_task(STRICT_STOVE), referent=referent).referent == "drawn"
    episode = Episode(get_task(STRICT_STOVE))
    for seed in range(20_000, 20_003):
        episode.reset(seed)
        assert episode.task == referent_of(get_task(STRICT_STOVE), seed)
    chosen = Episode(get_task(STRICT_STOVE).variant(2))
    assert chosen.referent == "fixed"
    for seed in range(20_000, 20_003):
        chosen.reset(seed)
        assert chosen.task.variant_index == 2


# --- prompt ---


def test_prompts_of_strict_tasks_have_one_length() -> None:
    for task in map(get_task, task_names(suite=None)):
        assert {task.variant(k).prompt_steps for k in task.random_variants} == {task.prompt_steps}
        assert (task.suite == STRICT) == (task.prompt_steps is not None)


# --- pacing ---


def paced(pause_steps: int = 0, speed: float = 1.0, replan_steps: int | None = None, seed: int = 0) -> Pacing:
    settings = EnvSettings(pause_steps=pause_steps, speed=speed, replan_steps=replan_steps)
    return Pacing(settings, np.random.default_rng(seed))


def executed(pacing: Pacing, steps: int) -> list[float | None]:
    """Return the first number of each executed action, where action k is k + 1; None in a pause."""
    found: list[float | None] = []
    for step in range(steps):
        moved = pacing.step(np.full(7, step + 1, np.float32))
        found.append(None if moved is None else float(moved[0]))
        assert moved is None or moved[6] == np.ceil(moved[6]), "the gripper is never scaled"
    return found


@pytest.mark.parametrize(
    ("speed", "replan", "expected"),
    [
        (1.0, None, [1, 2, 3, 4, 5, 6]),
        (0.5, None, [0.5, 0.5, 1.5, 1.5, 2.5, 2.5]),
        (0.33, 2, [1 / 3] * 3 + [2 / 3] * 3 + [7 / 3] * 3 + [8 / 3] * 3),
    ],
)
def test_slower_actions_are_stretched_by_chunk(speed: float, replan: int | None, expected: list[float]) -> None:
    assert executed(paced(0, speed, replan), len(expected)) == pytest.approx(expected)


@pytest.mark.parametrize(("speed", "replan"), [(1.0, None), (1.0, 7), (0.5, 7)])
def test_pauses_start_and_end_between_chunks(speed: float, replan: int | None) -> None:
    chunk, pacing = replan or 1, paced(100, speed, replan)
    rests = np.array([number is None for number in executed(pacing, 1500)])
    edges = np.flatnonzero(np.diff(rests.astype(int))) + 1
    assert len(edges) > 4
    assert all(edge % chunk == 0 for edge in edges)
    starts, ends = edges[::2], edges[1::2]
    assert {int(length) for length in ends - starts[: len(ends)]} == {-(-100 // chunk) * chunk}
    least, most = STEPS_BETWEEN_PAUSES
    assert all(least <= gap < most + chunk * round(1 / speed) for gap in np.diff([0, *edges])[::2])
    assert pacing.paused_steps == rests.sum()
    assert executed(paced(50), 400) == executed(paced(50), 400) != executed(paced(50, seed=1), 400)


def test_pauses_leave_the_expert_episode_unchanged() -> None:
    plain = run(get_task(STOVE), Episode.expert_action)
    steps, hashes = [], []

    def watched(episode: Episode) -> NDArray[np.float32]:
        steps.append((episode.clock, episode.rested))
        if episode.rested:
            hashes.append(episode.sim.scene_hash())
        return episode.expert_action()

    paused = run(get_task(STOVE), watched, pause_steps=40)
    rested = sum(rests for _, rests in steps)
    assert paused.pacing.paused_steps == rested >= 40
    assert len(set(hashes)) == rested // 40, "the scene rests in a pause"
    assert [clock for clock, _ in steps] == list(range(len(steps))), "the clock runs in a pause"
    for fact in ("success", "exec_steps"):
        assert getattr(paused, fact) == getattr(plain, fact)
    assert paused.success
    assert paused.progress.first_step == plain.progress.first_step
    assert paused.sim.scene_hash() == plain.sim.scene_hash()


def test_horizon_counts_actions_at_full_speed_without_pauses() -> None:
    episode = run(get_task(STOVE), horizon=60, pause_steps=30, speed=0.5)
    assert episode.exec_steps == 120
    assert episode.step_index == 120 + episode.pacing.paused_steps > 120
    assert episode.cut_off


# --- the end of strict and published episodes ---


def test_unreachable_goals_end_strict_episodes_only() -> None:
    never = Never(Atom("on", ("moka_pot_1", "kitchen_table_moka_pot_init_region")))
    published = run(dataclasses.replace(get_task(STOVE), goal=never), horizon=45)
    assert (published.progress.lost, published.lost, published.exec_steps) == (True, False, 45)
    strict = run(get_task(STRICT_STOVE))
    assert (strict.lost, strict.exec_steps) == (True, 40)
    assert episode_record(strict, 0, 0.1)["failure"] == "miscount"


# --- failures ---

QUICK = {"put_the_tomato_into_the_top_drawer_of_the_cabinet"}
ALL = [pytest.param(n, marks=[] if n in QUICK else pytest.mark.slow) for n in task_names(suite=None)]


@pytest.mark.parametrize("name", ALL)
def test_rest_and_random_motion_satisfy_no_checkpoint(name: str) -> None:
    rng = np.random.default_rng(SEED)
    moving = 150 if name in QUICK else 400
    for policy, steps in ((rest, 45), (lambda _: rng.uniform(-1, 1, 7).astype(np.float32), moving)):
        episode = run(get_task(name), policy, steps=steps, demonstration_prompt=name not in QUICK)
        assert episode.progress.first_step == [None] * len(episode.task.checkpoints)
        assert not episode.success


def acted(name: str, asked: int, answered: int, horizon: int = HORIZON) -> dict[str, Any]:
    """Return the record of an episode of one variant with the expert of another."""
    base = get_task(name)
    episode = Episode(base.variant(asked), demonstration_prompt=False, horizon=horizon)
    episode.reset(SEED)
    expert = Expert(base.variant(answered), episode.sim, np.random.default_rng(3))
    while not (episode.done or expert.done):
        episode.step(expert.act())
    return episode_record(episode, 0, wall_s=0.0)


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=[] if n == ASSEMBLY else pytest.mark.slow)
        for n in task_names("object") + task_names("procedural")
    ],
)
def test_failure_class_of_a_wrong_answer_and_of_a_short_horizon(name: str) -> None:
    first, second, *_ = get_task(name).random_variants
    assert acted(name, first, second)["failure"] == ("wrong_order" if name == ASSEMBLY else "reference_drift")
    assert acted(name, first, first, horizon=60)["failure"] == "cut_off"
    if name != ASSEMBLY:
        assert acted(name, first, first)["failure"] is None


# --- the authors' evaluation ---

CHECK = "check_the_top_drawer_of_the_cabinet"
OPENED = Atom("open", ("wooden_cabinet_1_top_region",))
AT_START = Atom("on", ("akita_black_bowl_1", "kitchen_table_akita_black_bowl_init_region"))


def drawer(goal: Formula, checkpoint: Formula = OPENED) -> Task:
    """Return the task with another goal and checkpoint; its bowl rests where it starts."""
    task = get_task(CHECK)
    return dataclasses.replace(
        task, goal=goal, checkpoints=(dataclasses.replace(task.checkpoints[0], goal=checkpoint),)
    )


def test_upstream_evaluates_twice_per_step_and_while_the_scene_settles() -> None:
    three_times = drawer(Then((AT_START, AT_START, AT_START)))
    assert run(three_times, seed=7).exec_steps == 30
    assert run(three_times, seed=7, rules="upstream").exec_steps == 15 - 10


def test_upstream_ends_when_all_checkpoints_have_held() -> None:
    upstream = run(drawer(OPENED, AT_START), seed=7, rules="upstream")
    assert (upstream.exec_steps, upstream.success, upstream.checkpoints_satisfied) == (1, False, True)
    assert episode_record(upstream, 0, 0.1)["failure"] == "execution_failure"
    paper = run(drawer(OPENED, AT_START), seed=7, horizon=3)
    assert (paper.exec_steps, paper.checkpoints_satisfied) == (3, False)
