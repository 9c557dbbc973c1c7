"""Does one arm solve more than another? The same episodes paired, over all training seeds.

The interval is of a bootstrap that draws training seeds and, within each task, episodes: a difference that depends on
how a training began is not a difference of arms. It is at least as wide as so few episodes allow (`estimates`). With
few training seeds it is still too narrow, and the test holds for these trainings only; the table says how many there
were.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison.estimates import DRAWS, Array, difference_interval
from lerobot_memobench.evaluation.comparison.paired_tests import detectable, holm, sign_flip
from lerobot_memobench.evaluation.metrics.rollouts import Record

Runs = Sequence[Sequence[Record]]
"""Rollouts of an arm: per training seed, in the same order of seeds for all arms."""


@dataclass(frozen=True)
class Contrast:
    """An arm's success less that of the reference, averaged as the report averages; fractions.

    Attributes:
        low, high: 95 % interval over training seeds and episodes.
        p: of sign flips of the episodes' differences, each the mean over training seeds; adjusted for the number of
            arms (Holm).
        episodes: how many were paired.
        detectable: smallest true difference that so many episodes show with 80 % power at 5 %; None above 1.
    """

    value: float
    low: float
    high: float
    p: float
    episodes: int
    detectable: float | None


def contrasts(arms: Mapping[str, Runs], reference: str) -> dict[str, Contrast]:
    """Return every other arm's difference from the reference.

    Raises:
        MemobenchError: arms have not rolled out the same episodes.
    """
    episodes = _episodes(arms[reference])
    weights, tasks = _weights(arms[reference][0], episodes)
    base = _table(arms[reference], episodes, reference)
    rng = np.random.default_rng(0)
    others = [name for name in arms if name != reference]
    gaps = {name: _table(arms[name], episodes, name) - base for name in others}
    p = holm([sign_flip(gap.mean(axis=0), weights, rng)[0] for gap in gaps.values()])
    return {
        name: Contrast(
            float((gap @ weights).mean()),
            *_interval(gap, weights, tasks, rng, base),
            adjusted,
            len(episodes),
            detectable(gap.mean(axis=0), weights),
        )
        for (name, gap), adjusted in zip(gaps.items(), p, strict=True)
    }


Key = tuple[str, int]


def _key(record: Record) -> Key:
    return str(record["task"]), int(record["seed"])


def _episodes(runs: Runs) -> list[Key]:
    return sorted(_key(record) for record in runs[0])


def _table(runs: Runs, episodes: Sequence[Key], name: str) -> Array:
    """Return success (training seeds, episodes), 0 or 1."""
    found = [{_key(record): float(bool(record["success"])) for record in records} for records in runs]
    if any(sorted(one) != list(episodes) for one in found):
        raise MemobenchError(f"the arm {name!r} has rolled out other episodes; finish all arms with the same seeds")
    return np.array([[one[episode] for episode in episodes] for one in found])


def _weights(records: Sequence[Record], episodes: Sequence[Key]) -> tuple[Array, list[list[int]]]:
    """Return each episode's weight (n,) in the mean of memory types of tasks, and the episodes' places by task."""
    type_of = {str(record["task"]): str(record["memory_type"]) for record in records}
    places: dict[str, list[int]] = {}
    for place, (task, _) in enumerate(episodes):
        places.setdefault(task, []).append(place)
    kinds = list(type_of.values())
    weights = np.array([1 / (len(set(kinds)) * kinds.count(type_of[task]) * len(places[task])) for task, _ in episodes])
    return weights, list(places.values())


def _interval(
    gap: Array, weights: Array, tasks: Sequence[Sequence[int]], rng: np.random.Generator, base: Array
) -> tuple[float, float]:
    """Return the 95 % interval of the weighted mean of differences from ``base`` (training seeds, episodes)."""
    draws = np.empty(DRAWS)
    for draw in range(DRAWS):
        seeds = rng.integers(0, len(gap), len(gap))
        chosen = np.concatenate([rng.choice(places, len(places)) for places in tasks])
        draws[draw] = float(gap[seeds].mean(axis=0)[chosen] @ weights[chosen])
    before = base.mean(axis=0)  # an episode counts once, however many policies were trained
    return difference_interval(draws, before, before + gap.mean(axis=0), weights)
