"""Tests, power and intervals for paired rollouts: the same episodes under two policies.

A pair gives a difference d in [-1, 1]: of success (-1, 0, 1) or of the share of checkpoints satisfied. A difference of
averages is the sum of w_i d_i, where the weights sum to 1 (equal for one task; for averages, each memory type, and in
it each task, weighs the same).

Intervals are percentiles of a bootstrap that draws episodes within each task and keeps the pairs together, so that what
both share (an easy scene) does not widen them; `scipy.stats.bootstrap` draws from one sample and knows no tasks. Draws
from equal outcomes are equal, as if no other outcome were possible: no interval is narrower than
Newcombe's of so many pairs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.metrics import Z95, wilson

EXACT_UP_TO = 16
"""Pairs that differ up to which all assignments of signs are enumerated: 2^16 = 65,536."""

PERMUTATIONS = 10_000

Array = NDArray[np.float64]
Values = Sequence[float] | Array

Z_POWER = 0.8416212335729143
"""Quantile of the normal distribution for 80 % power."""

FEWEST_PAIRS = 6
"""2 / 2^6 is under 5 %, 2 / 2^5 is not."""

_TOLERANCE = 1e-12


def mcnemar(only_a: int, only_b: int) -> float:
    """Return the exact two-sided p of McNemar's test, given the pairs in which only one of both succeeded."""
    from scipy.stats import binomtest

    discordant = only_a + only_b
    return float(binomtest(min(only_a, only_b), discordant).pvalue) if discordant else 1.0


def sign_flip(
    differences: Values, weights: Values, rng: np.random.Generator, permutations: int = PERMUTATIONS
) -> tuple[float, bool]:
    """Return the two-sided p of the weighted sum of differences under random signs, and whether it is exact.

    With at most ``EXACT_UP_TO`` pairs that differ, every assignment of signs is looked at; else ``permutations`` random
    ones and the one observed, p = (1 + as extreme) / (1 + drawn).

    `scipy.stats.permutation_test` refuses a single pair, misses sums that are equal but for rounding, and takes seven
    times as long.
    """
    terms = np.asarray(differences, dtype=np.float64) * np.asarray(weights, dtype=np.float64)
    terms = terms[np.abs(terms) > _TOLERANCE]
    observed = abs(float(terms.sum())) - _TOLERANCE  # sums that are equal but for rounding are as extreme
    if terms.size == 0:
        return 1.0, True
    if terms.size <= EXACT_UP_TO:
        sums = np.zeros(1)
        for term in terms:
            sums = np.concatenate([sums + term, sums - term])
        return float(np.mean(np.abs(sums) >= observed)), True
    extreme = 0
    for start in range(0, permutations, 1000):  # in parts: 1,500 pairs by 10,000 signs would be 120 MB
        count = min(1000, permutations - start)
        signs = rng.integers(0, 2, (count, terms.size)) * 2 - 1
        extreme += int(np.count_nonzero(np.abs(signs @ terms) >= observed))
    return (1 + extreme) / (1 + permutations), False


def detectable(differences: Values, weights: Values) -> float | None:
    """Return the smallest true difference that so many pairs show with 80 % power at 5 % two-sided; None for none.

    It is the δ with  n δ² = (1.96 √m + 0.84 √(m − δ²))²  (Connor 1987 for McNemar's test, where m is the share of
    discordant pairs). Here m is the mean square of the differences, taken from the pairs with one more that differs
    and one more that does not, so that it is not 0 where no pair differs (as in Agresti and Min 2005), and at least δ:
    a mean difference δ of values in [-1, 1] cannot come with a smaller mean square than δ². n is 1 / Σ w_i², the
    number of pairs of equal weight with the same standard error. With fewer than six pairs no outcome of an exact test
    is under 5 %.
    """
    from scipy.optimize import brentq

    d, w = np.asarray(differences, dtype=np.float64), np.asarray(weights, dtype=np.float64)
    if d.size < FEWEST_PAIRS:
        return None
    pairs = 1.0 / float(np.sum(w**2))
    # The mean square that enters the variance of the weighted sum weighs pairs by the squares of their weights.
    square = (float(np.sum(w**2 * d**2)) * pairs * d.size + 1.0) / (d.size + 2.0)

    def missing(delta: float) -> float:
        m = max(square, delta)
        spread = Z95 * math.sqrt(m) + Z_POWER * math.sqrt(max(0.0, m - delta * delta))
        return delta * math.sqrt(pairs) - spread

    return None if missing(1.0) < 0 else float(brentq(missing, 0.0, 1.0))


def holm(values: Sequence[float]) -> list[float]:
    """Return p-values adjusted for their number (Holm 1979), in the same order."""
    p, order = np.asarray(values, dtype=np.float64), np.argsort(values)  # scipy adjusts by other procedures only
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)).clip(max=1.0)
    return [float(value) for value in adjusted]


# --- bootstrap intervals ---

DRAWS = 2000


@dataclass(frozen=True)
class Estimate:
    """An estimate and its 95 % interval; None where it does not apply."""

    value: float | None
    low: float | None = None
    high: float | None = None


def interval_of(draws: Array, bounds: tuple[float, float]) -> tuple[float, float]:
    """Return the 95 % interval of bootstrap draws, at least as wide as ``bounds``."""
    low, high = np.percentile(draws, [2.5, 97.5])
    return min(float(low), bounds[0]), max(float(high), bounds[1])


def newcombe(a: Array, b: Array, weights: Array) -> tuple[float, float]:
    """Return Newcombe's interval of a difference of paired rates, b − a (Statistics in Medicine 17, 1998, method 10).

    ``a`` and ``b``, (n,), are outcomes in [0, 1] of the same episodes; the ``weights`` sum to 1. The interval follows
    from both rates' Wilson intervals and the correlation of the pairs, which is corrected for continuity. The number of
    trials is that of equal weights with the same standard error.
    """
    n = 1 / float(np.sum(weights**2))
    p, q = float(weights @ a), float(weights @ b)
    # A sum of weights may exceed 1 by rounding.
    (low_p, high_p), (low_q, high_q) = (wilson(min(max(rate, 0.0), 1.0), n) for rate in (p, q))
    together = float(weights @ ((a - p) * (b - q)))
    spread = math.sqrt(float(weights @ (a - p) ** 2) * float(weights @ (b - q) ** 2))
    together = max(together - 1 / (2 * n), 0.0) if together > 0 else together
    phi = together / spread if spread > 0 else 0.0

    def reach(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * phi * x * y + y * y, 0.0))

    return q - p - reach(q - low_q, high_p - p), q - p + reach(high_q - q, p - low_p)
