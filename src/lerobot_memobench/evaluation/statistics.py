"""Contrasts of paired rollouts, the same episodes under two policies: differences, tests, power and intervals.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.metrics import (
    MEMORY_TYPE,
    METRICS,
    PROCESS_METRICS,
    SUITE,
    Z95,
    Record,
    by_task,
    prefix,
    rollout_value,
    satisfied,
    varies,
    wilson,
)
from lerobot_memobench.tasks.catalogue import GROUPS, get_task, suite_of
from lerobot_memobench.tasks.task import LIBERO_SUITES, SUITES

EXACT_UP_TO = 16
"""Pairs that differ up to which all assignments of signs are enumerated: 2^16 = 65,536."""
PERMUTATIONS = 10_000
DRAWS = 2000  # of a bootstrap

Array = NDArray[np.float64]
Values = Sequence[float] | Array

Z_POWER = 0.8416212335729143
"""Quantile of the normal distribution for 80 % power."""
FEWEST_PAIRS = 6  # 2 / 2^6 is under 5 %, 2 / 2^5 is not
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
    """
    # `scipy.stats.permutation_test` refuses a single pair, misses sums that are equal but for rounding, and takes seven
    # times as long.
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


def nested_mean(groups: Sequence[Sequence[Any]]) -> Any:
    """Return the mean over groups of the means over their members."""
    return np.mean([np.mean(group, axis=0) for group in groups], axis=0)


# --- contrasts ---

Pair = tuple[Record, Record]
Kind = Literal["average", "memory type", "suite", "task", "family"]
LEAST_GAP = 0.01  # below it, one rollout would reverse the share of the gap that is closed


@dataclass(frozen=True)
class Contrast:
    """One metric of B against A over the same episodes. Rates are fractions.

    Attributes:
        metric: SR, MSR, MUR or MCR; of a task also c1, c2, …, prefix completion.
        n: number of pairs.
        interval: 95 % interval of b − a.
        p: exact McNemar for outcomes of yes or no, sign-flip permutation else.
        exact: whether every assignment of signs was tried.
        detectable: see the function of that name.
        only_a, only_b: pairs in which only one of both succeeded (SR and prefix completion only).
        adjusted: p of a task after Holm over the tasks.
        closed: `oracle_share`, where the control reports it.
    """

    kind: Kind
    scope: str
    metric: str
    n: int
    a: float
    b: float
    interval: tuple[float, float]
    p: float
    exact: bool
    detectable: float | None
    only_a: int | None = None
    only_b: int | None = None
    adjusted: float | None = None
    closed: Estimate | None = None

    @property
    def value(self) -> float:
        """The second rate minus the first."""
        return self.b - self.a


def oracle_share(first: float | None, second: float | None) -> float | None:
    """Return the share of the gap between ``first`` and 1 that ``second`` closes (paper, oracle memory)."""
    if first is None or second is None or 1.0 - first < LEAST_GAP:
        return None
    return (second - first) / (1.0 - first)


# --- tasks and scopes ---


class _Sample(NamedTuple):
    """A metric in the pairs of a task, (n, 2) in [0, 1], and its mean in each bootstrap draw, (`DRAWS`, 2)."""

    values: Array
    drawn: Array


class _TaskPairs(NamedTuple):
    name: str
    memory_type: str
    family: str | None
    samples: Mapping[str, _Sample]


def _tasks(pairs: Sequence[Pair], by_checkpoint: bool) -> list[_TaskPairs]:
    partners = {id(first): second for first, second in pairs}
    rng = np.random.default_rng(0)  # intervals do not depend on the seed of the random signs
    tasks = []
    for name, group in by_task(first for first, _ in pairs).items():
        both = [(record, partners[id(record)]) for record in group]
        values = {
            metric: np.array([[rollout_value(r, metric) for r in pair] for pair in both], float) for metric in METRICS
        }
        if by_checkpoint:
            reached = np.array([[prefix(satisfied(record)) for record in pair] for pair in both], dtype=float)
            values |= {f"c{k + 1}": reached[:, :, k] for k in range(reached.shape[2])}
        scenes = _scenes(group)  # rollouts of one scene depend on each other, so they are drawn together
        drawn = scenes[rng.integers(len(scenes), size=(DRAWS, len(scenes)))].reshape(DRAWS, -1)
        samples = {
            metric: _Sample(value, value[drawn].mean(axis=1))
            for metric, value in values.items()
            if not np.isnan(value).any()  # does not apply
        }
        family = get_task(name).family if suite_of(name) in SUITES else None
        tasks.append(_TaskPairs(name, str(group[0]["memory_type"]), family, samples))
    return tasks


def _scenes(group: Sequence[Record]) -> NDArray[np.int64]:
    """Return the rollouts of each scene of a task by their index, (S, V): V is 1 unless each scene has V variants."""
    scenes: dict[Any, list[int]] = {}
    for k, record in enumerate(group):
        scenes.setdefault(record.get("seed") if varies(record) else (k,), []).append(k)
    whole = len({len(scene) for scene in scenes.values()}) == 1
    return np.array(list(scenes.values()) if whole else [[k] for k in range(len(group))])


def _scopes(tasks: Sequence[_TaskPairs]) -> list[tuple[Kind, str, list[list[_TaskPairs]]]]:
    """Return kind, name and groups of tasks of each scope, in the report's order; a rate is the mean over groups."""
    types = [[task for task in tasks if task.memory_type == name] for name in GROUPS]
    families = {task.family: [other for other in tasks if other.family == task.family] for task in tasks if task.family}
    types = [group for group in types if group]
    kind: Kind = SUITE if tasks[0].memory_type in LIBERO_SUITES else MEMORY_TYPE
    alone = kind == SUITE and len(types) == 1
    return [
        ("average", tasks[0].memory_type if alone else f"average of {kind}s", types),
        *((kind, group[0].memory_type, [group]) for group in types if not alone),
        *(("task", task.name, [[task]]) for task in tasks),
        *(("family", str(name), [group]) for name, group in families.items()),
    ]


# --- one metric in one scope ---


def contrasts_of(
    pairs: Sequence[Pair],
    rng: np.random.Generator,
    permutations: int = PERMUTATIONS,
    *,
    by_checkpoint: bool = False,
    closes: bool = False,
) -> list[Contrast]:
    """Return the contrasts of each scope, of prefix completion of tasks too where ``by_checkpoint``.

    ``rng`` draws signs; ``closes``: whether `oracle_share` is computed.
    """
    contrasts = []
    for kind, scope, groups in _scopes(_tasks(pairs, by_checkpoint)):
        for metric in groups[0][0].samples if kind == "task" else METRICS:
            samples = [[task.samples[metric] for task in group if metric in task.samples] for group in groups]
            if applicable := [group for group in samples if group]:
                contrasts.append(_contrast((kind, scope), metric, applicable, rng, permutations, closes))
    for metric in METRICS:
        of_tasks = [k for k, contrast in enumerate(contrasts) if contrast.metric == metric and contrast.kind == "task"]
        for k, p in zip(of_tasks, holm([contrasts[k].p for k in of_tasks]), strict=True):
            contrasts[k] = replace(contrasts[k], adjusted=p)
    return contrasts


def _contrast(
    scope: tuple[Kind, str],
    metric: str,
    groups: list[list[_Sample]],
    rng: np.random.Generator,
    permutations: int,
    closes: bool,
) -> Contrast:
    values = [sample.values for group in groups for sample in group]
    sizes = [len(groups) * len(group) * len(sample.values) for group in groups for sample in group]
    before, after = np.concatenate(values).T
    weights = np.concatenate([np.full(len(value), 1 / size) for value, size in zip(values, sizes, strict=True)])
    drawn = nested_mean([[sample.drawn for sample in group] for group in groups])
    # Summed as the report sums, so that both print the same digits.
    a, b = (_mean([_mean([_mean(s.values[:, k].tolist()) for s in group]) for group in groups]) for k in (0, 1))
    bounds, d = newcombe(before, after, weights), after - before
    only_a = only_b = None
    if metric in PROCESS_METRICS:
        p, exact = sign_flip(d, weights, rng, permutations)
    else:
        only_a, only_b, exact = int(np.sum(d < 0)), int(np.sum(d > 0)), True
        p = mcnemar(only_a, only_b)
    return Contrast(
        *scope,
        metric=metric,
        n=len(d),
        a=a,
        b=b,
        interval=interval_of(drawn[:, 1] - drawn[:, 0], bounds),
        p=p,
        exact=exact,
        detectable=detectable(d, weights),
        only_a=only_a,
        only_b=only_b,
        closed=_closed(a, b, drawn, bounds) if closes else None,
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _closed(a: float, b: float, drawn: Array, bounds: tuple[float, float]) -> Estimate:
    value = oracle_share(a, b)
    shares = [share for pair in drawn.tolist() if (share := oracle_share(*pair)) is not None]
    if value is None or len(shares) <= 0.9 * len(drawn):  # the gap vanishes in too many draws for an interval
        return Estimate(value)
    low, high = interval_of(np.array(shares), (bounds[0] / (1.0 - a), bounds[1] / (1.0 - a)))
    return Estimate(value, low, min(high, 1.0))
