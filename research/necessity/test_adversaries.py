"""No strategy without a memory solves a strict task more often than its ceiling."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import binom

from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.evaluation.metrics import wilson
from lerobot_memobench.tasks.catalogue import get_task, task_names
from research.necessity.adversaries import SHOWN, STRATEGIES, UNBOUND, ceiling, counted, rollout

FINDING = "find_the_artichoke_hidden_in_one_of_the_drawers"
COUNTING = "check_the_middle_drawer_a_given_number_of_times"


def test_a_look_into_a_wrong_drawer_loses() -> None:
    # The drawer that is tried first is the bottom one, in which variant 2 hides the artichoke.
    seed = next(seed for seed in range(20_000, 20_010) if referent_of(get_task(FINDING), seed).variant_index != 2)
    assert rollout(FINDING, "peek 6 cm", seed)["lost"]


@pytest.mark.parametrize("strategy", ["another joint is the note", "the clock", SHOWN])
def test_events_are_counted_by_a_clock_that_is_not_shown(strategy: str) -> None:
    seed = next(seed for seed in range(20_000, 20_010) if referent_of(get_task(COUNTING), seed).variant_index == 1)
    assert rollout(COUNTING, strategy, seed)["success"] == (strategy == SHOWN)


def test_ceilings() -> None:
    found = {name: ceiling(get_task(name)) for name in task_names(suite="strict")}
    assert found[COUNTING] == pytest.approx((1 / 4 + 4 / 27 + 27 / 256) / 3, abs=0.005)
    assert found[FINDING] == pytest.approx(1 / 3)
    assert 0 < min(found.values()) <= max(found.values()) <= 0.5


def test_the_ceiling_of_counting_is_what_staying_by_chance_reaches() -> None:
    """Ten thousand policies at home, step by step: some stay for 40 steps before the event, some leave after it."""
    rng, stay = np.random.default_rng(0), 0.5 ** (1 / 39)
    before, after = rng.geometric(1 - stay, (2, 10_000)) - 1
    solved = np.mean((before + 1 < 40) & (1 + after + 1 >= 40))
    low, high = wilson(float(solved), 10_000)
    assert low < counted(1, 40) < high


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", task_names(suite="strict"))
def test_no_strategy_exceeds_the_ceiling(name: str) -> None:
    task, scenes = get_task(name), 6
    for strategy in STRATEGIES[str(task.family)].keys() - UNBOUND:
        solved = sum(bool(rollout(name, strategy, 20_100 + scene)["success"]) for scene in range(scenes))
        assert solved <= binom.ppf(0.9999, scenes, ceiling(task)), strategy
