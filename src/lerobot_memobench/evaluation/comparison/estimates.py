"""Figures with bootstrap intervals, and how they are written: in cells in per cent, in JSON with one decimal.

Intervals are percentiles of a bootstrap that draws episodes within each task and keeps the pairs together, so that what
both share (an easy scene) does not widen them; `scipy.stats.bootstrap` draws from one sample and knows no tasks. Rates
are fractions here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.documents.tables import NOT_APPLICABLE
from lerobot_memobench.evaluation.metrics.rates import percent

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
