"""No strategy without a memory solves a strict task more often than its ceiling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom, gamma

from lerobot_memobench.constants import LONGEST_HOLD
from lerobot_memobench.envs.episode import Episode, referent_of
from lerobot_memobench.envs.pacing import Pacing
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.necessity.adversaries import (
    DECLARED,
    NOTHING,
    STRATEGIES,
    UNBOUND,
    Seat,
    _look,
    ceiling,
    counted,
    rollout,
)
from research.necessity.clock import BINS, EPISODES, WAIT, WIDTH, counting

FINDING = "find_the_artichoke_hidden_in_one_of_the_drawers"
COUNTING = "check_the_middle_drawer_a_given_number_of_times"
ORDERING = "check_all_three_drawers_once_each_in_the_given_order"


def test_a_look_into_a_wrong_drawer_loses() -> None:
    # The drawer that is tried first is the bottom one, in which variant 2 hides the artichoke.
    seed = next(seed for seed in range(20_000, 20_010) if referent_of(get_task(FINDING), seed).variant_index != 2)
    assert rollout(FINDING, "peek 6 cm", seed)["lost"]


def test_a_camera_inside_a_shut_drawer_shows_nothing() -> None:
    seed = next(seed for seed in range(20_000, 20_010) if referent_of(get_task(FINDING), seed).variant_index == 0)
    episode = Episode(get_task(FINDING), demonstration_prompt=False)
    episode.reset(seed, keep_prompt=True)
    while not episode.action_has_effect:
        episode.step(NOTHING)
    seat = Seat(episode, Expert(episode.task, episode.sim, np.random.default_rng(0)), np.random.default_rng(0))
    body = episode.sim.model.body("artichoke_1").id
    for action in _look(seat, "top"):
        episode.step(action)
        assert not (episode.sim.visible_bodies("wrist") == body).any()
    assert not episode.lost


@pytest.mark.slow
@pytest.mark.parametrize("strategy", DECLARED)
@pytest.mark.parametrize("name", [COUNTING, ORDERING])
def test_without_holds_a_plan_that_passes_home_is_a_memory(
    monkeypatch: pytest.MonkeyPatch, strategy: str, name: str
) -> None:
    """The first choice is by chance, as nothing is known at the start: here it is the right one."""
    monkeypatch.setattr(Pacing, "hold", lambda self, steps: None)
    monkeypatch.setattr(Seat, "guess", lambda self: 0)
    assert sum(bool(rollout(name, strategy, seed)["success"]) for seed in range(20_000, 20_004)) >= 3


def test_ceilings() -> None:
    found = {name: ceiling(get_task(name)) for name in task_names(suite="strict")}
    assert found[COUNTING] == pytest.approx((1 / 4 + 4 / 27 + 27 / 256) / 3)
    assert found[ORDERING] == pytest.approx(1 / 27)
    assert found[FINDING] == pytest.approx(1 / 3)
    assert 0 < min(found.values()) <= max(found.values()) <= 0.5


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_ceiling_of_counting_is_the_best_probability_to_go_on(number: int) -> None:
    """Of policies that go on with a fixed probability after each release, none is better, and one is as good."""
    going_on = np.linspace(0.0, 1.0, 1_001)
    assert counted(number) == pytest.approx(float(np.max(going_on**number * (1 - going_on))), abs=1e-5)


def test_waiting_for_a_step_of_the_clock_needs_a_short_first_hold() -> None:
    """Begin the one event at step 800 if home is released by then, and rest at every later release."""
    plan = np.full(BINS, 1)
    plan[: 800 // WIDTH], plan[800 // WIDTH] = WAIT, 0
    rate = counting(1, lambda rng, count: rng.gamma(0.5, 1200, (EPISODES, count))).rate(plan)
    assert rate == pytest.approx(gamma.cdf(840, 0.5, scale=1200), abs=0.03)
    assert rate > 2.5 * counted(1)
    clock = counting(1)
    assert clock.rate(plan) == pytest.approx(840 / LONGEST_HOLD, abs=0.03)
    assert clock.rate(plan) < counted(1)
    assert clock.rate(np.full(BINS, 0)) == clock.rate(np.full(BINS, 1)) == 0.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("family", "strategy"),
    [(family, strategy) for family, known in STRATEGIES.items() for strategy in sorted(known.keys() - UNBOUND)],
)
def test_no_strategy_exceeds_the_ceiling(family: str, strategy: str) -> None:
    """Each task, and the family together: of a task with a ceiling of 25 %, six of six scenes are not improbable."""
    tasks, scenes = [task for task in map(get_task, task_names(suite="strict")) if task.family == family], 6
    solved = 0
    for task in tasks:
        own = sum(bool(rollout(task.name, strategy, 20_100 + scene)["success"]) for scene in range(scenes))
        assert own <= binom.ppf(0.9999, scenes, ceiling(task)), task.name
        solved += own
    # A sum of unequal probabilities has lighter tails than the binomial of their mean (Hoeffding 1956).
    most = binom.ppf(0.9999, scenes * len(tasks), np.mean([ceiling(task) for task in tasks]))
    assert solved <= most < 0.8 * scenes * len(tasks)
