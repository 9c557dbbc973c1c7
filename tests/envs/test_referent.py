"""A random referent is fair, cannot be told from the seed by a rule (no physics), and a mistaken one is told apart."""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy import stats

from lerobot_memobench.envs.episode import Episode, referent_of
from lerobot_memobench.envs.episode_log import episode_record
from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.protocol import PAPER, SEALED, SPLITS, VALIDATION
from lerobot_memobench.tasks.catalogue import get_task, task_names

SEEDS = 400
FAIR = 1e-6
"""A fair draw fails a check less often than this."""

PUBLISHED_WITH_VARIANTS = [name for name in task_names() if get_task(name).num_variants > 1]
STRICT_WITH_VARIANTS = [name for name in task_names(suite="strict") if get_task(name).num_variants > 1]
STACK = "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"
WITH_VARIANTS = PUBLISHED_WITH_VARIANTS + STRICT_WITH_VARIANTS


@cache
def drawn(name: str, first: int, count: int = SEEDS) -> list[int]:
    """The variants of consecutive seeds; drawn once for all tests."""
    task = get_task(name)
    return [referent_of(task, seed).variant_index for seed in range(first, first + count)]


def test_object_and_procedural_tasks_have_variants_and_no_other() -> None:
    assert task_names(["object", "procedural"]) == PUBLISHED_WITH_VARIANTS


@pytest.mark.parametrize("name", [name for name in task_names() if name not in WITH_VARIANTS])
def test_a_task_with_one_goal_keeps_it(name: str) -> None:
    assert referent_of(get_task(name), 7) is get_task(name)


@pytest.mark.parametrize("split", [PAPER, "demonstrations", VALIDATION, SEALED])
@pytest.mark.parametrize("name", WITH_VARIANTS)
def test_the_first_episodes_of_a_split_show_every_admissible_variant_as_often(name: str, split: str) -> None:
    admissible = get_task(name).random_variants
    for episodes in (4, 10, 50, SEEDS):
        variants = drawn(name, SPLITS[split].start)[:episodes]
        counts = [variants.count(k) for k in admissible]
        assert sum(counts) == episodes, "a variant was drawn that is not admissible"
        assert max(counts) - min(counts) <= 1


def test_an_episode_has_its_variant_wherever_an_evaluation_begins() -> None:
    """Parts, resumed runs and `seed=` draw what the whole evaluation does: the seed alone decides."""
    assert drawn(STACK, 20_000)[13:40] == drawn(STACK, 20_013, 27)


def firsts(name: str, split: str) -> list[int]:
    """What comes first in each round of a split, as numbers from 0 on."""
    admissible = get_task(name).random_variants
    return [admissible.index(k) for k in drawn(name, SPLITS[split].start)[:: len(admissible)]]


@pytest.mark.parametrize("name", WITH_VARIANTS)
def test_rounds_do_not_follow_from_one_another(name: str) -> None:
    """What comes first in a round is as likely to be any, and no period tells it."""
    number, found = len(get_task(name).random_variants), firsts(name, VALIDATION)
    assert stats.chisquare([found.count(k) for k in range(number)]).pvalue > FAIR
    for period in range(1, 17):
        pairs = list(zip(found, found[period:], strict=False))
        test = stats.binomtest(sum(a == b for a, b in pairs), len(pairs), 1 / number)
        assert test.pvalue > FAIR, f"rounds {period} apart agree too often or too rarely"


@pytest.mark.parametrize("name", WITH_VARIANTS)
def test_evaluation_and_demonstration_seeds_share_no_pattern(name: str) -> None:
    """Rounds of the evaluation and of demonstrations agree as often as chance has it, whatever the offset."""
    evaluation, demonstrations = firsts(name, PAPER), firsts(name, "demonstrations")
    for offset in range(5):
        pairs = list(zip(evaluation[offset:], demonstrations, strict=False))
        test = stats.binomtest(sum(a == b for a, b in pairs), len(pairs), 1 / len(get_task(name).random_variants))
        assert test.pvalue > FAIR


def test_tasks_do_not_share_their_draws() -> None:
    """Two tasks with as many variants do not show the same place in the same round."""
    two = [name for name in WITH_VARIANTS if len(get_task(name).random_variants) == 2]
    assert len(two) > 2
    for a, b in pairwise(firsts(name, PAPER) for name in two):
        same = sum(x == y for x, y in zip(a, b, strict=True))
        assert stats.binomtest(same, len(a), 1 / 2).pvalue > FAIR


# --- what an answer to another prompt counts as ---


def acted(name: str, asked: int, answered: int, horizon: int = 1200) -> dict[str, Any]:
    """The record of an episode that asks for one variant, under the expert of another."""
    base = get_task(name)
    episode = Episode(base.variant(asked), demonstration_prompt=False, horizon=horizon)
    episode.reset(20_000)
    expert = Expert(base.variant(answered), episode.sim, np.random.default_rng(3))
    while not (episode.done or expert.done):
        episode.step(expert.act())
    return episode_record(episode, episode.seed - 20_000, wall_s=0.0)


PROCEDURES = task_names("procedural")
QUICK = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"


@pytest.mark.parametrize("name", [pytest.param(n, marks=[] if n == QUICK else [pytest.mark.slow]) for n in PROCEDURES])
def test_a_procedure_of_another_prompt_is_a_memorys_failure_and_a_short_horizon_none(name: str) -> None:
    first, second, *_ = get_task(name).random_variants
    right = acted(name, first, first)
    assert (right["success"], right["failure"]) == (True, None)
    assert acted(name, first, second)["failure"] == ("wrong_order" if name == QUICK else "reference_drift")
    assert acted(name, first, first, horizon=right["steps"] // 2)["failure"] == "cut_off"


@pytest.mark.slow
@pytest.mark.parametrize("name", task_names("object"))
def test_the_object_of_another_prompt_is_a_drift(name: str) -> None:
    first, second, *_ = get_task(name).random_variants
    assert acted(name, first, first)["failure"] is None
    assert acted(name, first, second)["failure"] == "reference_drift"
