"""Figures with bootstrap intervals, and how they are written: in cells in per cent, in JSON with one decimal.

Intervals are percentiles of a bootstrap that draws episodes within each task and keeps the pairs together, so that what
both share (an easy scene) does not widen them; `scipy.stats.bootstrap` draws from one sample and knows no tasks. Draws
from outcomes that are all equal are equal, as if nothing else could have happened: no interval is narrower than
Newcombe's of so many pairs. Rates are fractions here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE
from lerobot_memobench.evaluation.metrics.rates import percent, wilson

DRAWS = 2000
"""Bootstrap draws."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A figure and its 95 % interval; None where it does not apply."""

    value: float | None
    low: float | None = None
    high: float | None = None


def percentiles(values: Array) -> tuple[float, float]:
    """Return the 95 % interval of draws."""
    low, high = np.percentile(values, [2.5, 97.5])
    return float(low), float(high)


def difference_interval(draws: Array, a: Array, b: Array, weights: Array) -> tuple[float, float]:
    """Return the 95 % interval of a weighted mean of b − a: that of the bootstrap's draws, or the wider bound.

    Args:
        draws: (D,) of that mean. a, b: (n,) outcomes in [0, 1] of the same episodes. weights: (n,), their sum is 1.
    """
    low, high = percentiles(draws)
    least, most = newcombe(a, b, weights)
    return min(low, least), max(high, most)


def newcombe(a: Array, b: Array, weights: Array) -> tuple[float, float]:
    """Return Newcombe's interval of a difference of paired rates, b − a (Statistics in Medicine 17, 1998, method 10).

    It is made of both rates' Wilson intervals and the correlation of the pairs, which is corrected for continuity. The
    number of trials is that of equal weights with the same standard error.
    """
    n = 1 / float(np.sum(weights**2))
    p, q = float(weights @ a), float(weights @ b)
    (low_p, high_p), (low_q, high_q) = (wilson(min(max(rate, 0.0), 1.0), n) for rate in (p, q))
    together = float(weights @ ((a - p) * (b - q)))
    spread = math.sqrt(float(weights @ (a - p) ** 2) * float(weights @ (b - q) ** 2))
    together = max(together - 1 / (2 * n), 0.0) if together > 0 else together
    phi = together / spread if spread > 0 else 0.0

    def reach(x: float, y: float) -> float:
        return math.sqrt(max(x * x - 2 * phi * x * y + y * y, 0.0))

    return q - p - reach(q - low_q, high_p - p), q - p + reach(high_q - q, p - low_p)


def number(value: float | None, sign: bool = False) -> str:
    """Return a fraction as per cent with one decimal."""
    if value is None:
        return NOT_APPLICABLE
    return f"{100.0 * value:+.1f}" if sign else f"{100.0 * value:.1f}"


def estimate(found: Estimate, sign: bool = False) -> str:
    """Return an estimate with its interval."""
    if found.low is None or found.high is None:
        return number(found.value, sign)
    return f"{number(found.value, sign)} [{number(found.low, sign)}, {number(found.high, sign)}]"


def as_percent(value: Any) -> Any:
    """Return a dataclass, mapping, sequence or rate with every rate in per cent with one decimal, for JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return as_percent(dataclasses.asdict(value))
    if isinstance(value, Mapping):
        return {key: as_percent(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_percent(item) for item in value]
    return percent(value) if isinstance(value, float) else value
