"""Paired tests against values worked out by hand, and their power against the exact distribution."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from statsmodels.stats.multitest import multipletests

from lerobot_memobench.evaluation.statistics import detectable, holm, mcnemar, sign_flip


@pytest.mark.parametrize(
    ("only_a", "only_b", "p"),
    [(0, 0, 1.0), (0, 5, 2 / 32), (0, 6, 2 / 64), (6, 0, 2 / 64), (2, 8, 2 * (1 + 10 + 45) / 1024), (4, 4, 1.0)],
)
def test_mcnemar_is_the_two_sided_binomial_tail(only_a: int, only_b: int, p: float) -> None:
    assert mcnemar(only_a, only_b) == pytest.approx(p)


def equal(n: int) -> Sequence[float]:
    return [1 / n] * n


def test_sign_flip_enumerates_few_pairs() -> None:
    rng = np.random.default_rng(0)
    # Signs of 0.5, 0.5, 1: |sum| is 2, 1, 1, 0, 0, 1, 1, 2, so 2 of 8 reach the observed 2.
    assert sign_flip([0.5, 0.5, 1.0], equal(3), rng) == (0.25, True)
    assert sign_flip([0.5, -0.5, 1.0], equal(3), rng) == (6 / 8, True)
    assert sign_flip([0.0, 0.0], equal(2), rng) == (1.0, True)
    assert sign_flip([1.0] * 6 + [0.0] * 44, equal(50), rng) == (2 / 64, True)


def test_sign_flip_draws_for_many_pairs_and_repeats_with_the_seed() -> None:
    differences = [1.0] * 20 + [-1.0] * 9
    first, exact = sign_flip(differences, equal(29), np.random.default_rng(3), 4000)
    assert not exact
    assert first == pytest.approx(mcnemar(9, 20), abs=0.02)
    assert sign_flip(differences, equal(29), np.random.default_rng(3), 4000)[0] == first
    assert sign_flip([1.0] * 40, equal(40), np.random.default_rng(0), 1000)[0] == 1 / 1001  # never 0


@given(st.lists(st.sampled_from([-1.0, -0.5, 0.0, 0.5, 1.0]), min_size=1, max_size=8))
def test_sign_flip_does_not_care_who_is_first(differences: list[float]) -> None:
    rng = np.random.default_rng(0)
    weights = equal(len(differences))
    assert sign_flip(differences, weights, rng) == sign_flip([-d for d in differences], weights, rng)


def exact_power(n: int, delta: float, discordant: float) -> float:
    """Power of exact McNemar at 5 %, from the binomial distributions themselves."""
    up = (discordant + delta) / (2 * discordant)
    power = 0.0
    for m in range(n + 1):
        chance = math.comb(n, m) * discordant**m * (1 - discordant) ** (n - m)
        if chance < 1e-12:
            continue
        power += chance * sum(
            math.comb(m, k) * up**k * (1 - up) ** (m - k) for k in range(m + 1) if mcnemar(m - k, k) <= 0.05
        )
    return power


def test_the_detectable_difference_is_detected_four_times_in_five() -> None:
    n, discordant = 50, 15
    differences = [1.0] * (discordant // 2) + [-1.0] * (discordant - discordant // 2) + [0.0] * (n - discordant)
    delta = detectable(differences, equal(n))
    # The exact test is conservative, so its power lies somewhat under the formula's 80 %.
    assert 0.68 < exact_power(n, delta, (discordant + 1) / (n + 2)) < 0.85


def test_where_no_pair_differs_the_detectable_difference_is_not_zero() -> None:
    # All discordant pairs fall one way: about (1.96 + 0.84)² = 7.85 of them are needed.
    delta = detectable([0.0] * 200, equal(200))
    assert delta == pytest.approx(7.85 / 200, rel=0.05)
    assert detectable([0.0] * 5, equal(5)) is None


def test_holm() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.6, 0.9]) == [1.0, 1.0]
    assert holm([]) == []
    values = np.random.default_rng(0).random(200).round(2) ** 3  # with ties
    assert holm(list(values)) == pytest.approx(multipletests(values, method="holm")[1])
