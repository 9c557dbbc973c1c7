"""Does a policy need its subgoals in order? How far rollouts come with normal and with shuffled memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.evaluation.comparison.estimates import DRAWS, Array, Estimate, percentiles
from lerobot_memobench.evaluation.metrics.rollouts import Record, by_task, prefix, satisfied


@dataclass(frozen=True)
class PrefixCurve:
    """Prefix completion of one task under two evaluations, (K + 1,): each checkpoint, then success.

    Attributes:
        normal, other: rates.
        differences: other − normal.
        n: episodes.
    """

    task: str
    normal: tuple[float, ...]
    other: tuple[float, ...]
    differences: tuple[Estimate, ...]
    n: int


def prefix_curves(
    normal: Sequence[Record], other: Sequence[Record], draws: int = DRAWS, seed: int = 0
) -> list[PrefixCurve]:
    """Return how far the rollouts of both come, per task; rollouts are paired already.

    A checkpoint counts when it and all before it were satisfied at some step (paper, prefix completion); the last entry
    is success.
    """
    curves = []
    others = by_task(other)
    for task, group in by_task(normal).items():
        a, b = _prefixes(group), _prefixes(others[task])
        chosen = np.random.default_rng(seed).integers(len(group), size=(draws, len(group)))
        step = (b - a)[chosen].mean(axis=1)
        difference = (b - a).mean(axis=0)
        curves.append(
            PrefixCurve(
                task,
                tuple(a.mean(axis=0).tolist()),
                tuple(b.mean(axis=0).tolist()),
                tuple(Estimate(float(d), *percentiles(step[:, k])) for k, d in enumerate(difference)),
                len(group),
            )
        )
    return curves


def _prefixes(group: Sequence[Record]) -> Array:
    return np.array([[*prefix(satisfied(record)), bool(record["success"])] for record in group], dtype=float)
