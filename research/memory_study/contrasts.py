"""Success of a row over training seeds, and differences between rows.

A difference pairs the same episodes, over all training seeds. Its interval is of a bootstrap that draws training seeds
and, within each task, episodes, and is at least as wide as so few episodes allow (`statistics`). With few training
seeds it is still too narrow. The test of episodes holds for these trainings only, that of training seeds for trainings
at large; tables have both.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import ttest_1samp

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Record, wilson
from lerobot_memobench.evaluation.statistics import (
    DRAWS,
    Array,
    Estimate,
    detectable,
    holm,
    interval_of,
    newcombe,
    sign_flip,
)

Runs = Sequence[Sequence[Record]]
"""Rollouts of a row per training seed, in the same order of seeds for all rows."""


@dataclass(frozen=True)
class SeedContrast:
    """A row's success minus that of a reference, averaged as the report averages; fractions.

    Attributes:
        low, high: 95 % interval over training seeds and episodes.
        p: of sign flips of the episodes' differences, each the mean over training seeds.
        detectable: see `statistics.detectable`.
        of_seeds: the difference of each training seed.
        p_of_seeds: of a paired t test over them; None with fewer than three.
    """

    value: float
    low: float
    high: float
    p: float
    episodes: int
    detectable: float | None
    of_seeds: tuple[float, ...]
    p_of_seeds: float | None


def contrast(runs: Runs, reference: Runs, name: str = "row", reference_name: str = "reference") -> SeedContrast:
    """Return a row's difference from a reference with the same training seeds; its p are not adjusted."""
    episodes, rng = episodes_of(reference), np.random.default_rng(0)
    weights, tasks = _weights(reference[0], episodes)
    base = _successes(reference, episodes, reference_name)
    _check_scenes(runs, reference, name, reference_name)
    gap = _successes(runs, episodes, name) - base
    of_seeds = gap @ weights
    before = base.mean(axis=0)  # an episode counts once, however many policies were trained
    low, high = interval_of(_draws(gap, weights, tasks, rng), newcombe(before, before + gap.mean(axis=0), weights))
    return SeedContrast(
        float(of_seeds.mean()),
        low,
        high,
        sign_flip(gap.mean(axis=0), weights, rng)[0],
        len(episodes),
        detectable(gap.mean(axis=0), weights),
        tuple(of_seeds.tolist()),
        _p_of_seeds(of_seeds),
    )


def adjusted(found: Mapping[str, SeedContrast]) -> dict[str, SeedContrast]:
    """Return differences with p adjusted for their number (Holm)."""
    of_episodes = holm([each.p for each in found.values()])
    tested = {name: each.p_of_seeds for name, each in found.items() if each.p_of_seeds is not None}
    of_seeds = dict(zip(tested, holm(list(tested.values())), strict=True))
    return {
        name: replace(each, p=p, p_of_seeds=of_seeds.get(name))
        for (name, each), p in zip(found.items(), of_episodes, strict=True)
    }


def average_success(runs: Runs) -> Estimate:
    """Return a row's success, averaged as the report averages, with its 95 % interval over seeds and episodes."""
    episodes = episodes_of(runs)
    weights, tasks = _weights(runs[0], episodes)
    table = _successes(runs, episodes, "training seeds")
    value = float((table @ weights).mean())
    # An episode counts once, however many policies ran it.
    bounds = wilson(min(value, 1.0), 1 / float(np.sum(weights**2)))
    return Estimate(value, *interval_of(_draws(table, weights, tasks, np.random.default_rng(0)), bounds))


def _p_of_seeds(differences: Array) -> float | None:
    """Return the two-sided p of a paired t test; None with fewer than three seeds, or with equal differences."""
    if len(differences) < 3 or np.ptp(differences) < 1e-9:
        return None
    return float(ttest_1samp(differences, 0.0).pvalue)


Key = tuple[str, int]


def _key(record: Record) -> Key:
    return str(record["task"]), int(record["seed"])


def episodes_of(runs: Runs) -> list[Key]:
    """Return task and seed of each rollout of the first training seed, sorted."""
    return sorted(_key(record) for record in runs[0])


def _check_scenes(runs: Runs, reference: Runs, name: str, reference_name: str) -> None:
    others = {_key(record): record for records in reference for record in records}
    for record in (record for records in runs for record in records):
        other = others.get(_key(record), {})
        for key in ("suite", "referent", "variant"):  # hashes of these logs differ between processors
            if None not in (a := record.get(key), b := other.get(key)) and a != b:
                raise MemobenchError(
                    f"{record['task']}, seed {record['seed']}: {key} is {a} for {name!r} and {b} for "
                    f"{reference_name!r}; compare rollouts of the same scenes"
                )


def _successes(runs: Runs, episodes: Sequence[Key], name: str) -> Array:
    found = [{_key(record): float(bool(record["success"])) for record in records} for records in runs]
    if any(sorted(each) != list(episodes) for each in found):
        raise MemobenchError(f"{name!r} has other episodes; finish all rows with the same seeds")
    return np.array([[each[episode] for episode in episodes] for each in found])


def _weights(records: Sequence[Record], episodes: Sequence[Key]) -> tuple[Array, list[list[int]]]:
    """Return each episode's weight (n,) in the mean of memory types of tasks, and the episodes' indices by task."""
    type_of = {str(record["task"]): str(record["memory_type"]) for record in records}
    indices: dict[str, list[int]] = {}
    for index, (task, _) in enumerate(episodes):
        indices.setdefault(task, []).append(index)
    kinds = list(type_of.values())
    weights = np.array(
        [1 / (len(set(kinds)) * kinds.count(type_of[task]) * len(indices[task])) for task, _ in episodes]
    )
    return weights, list(indices.values())


def _draws(table: Array, weights: Array, tasks: Sequence[Sequence[int]], rng: np.random.Generator) -> Array:
    seeds = rng.multinomial(len(table), np.full(len(table), 1 / len(table)), DRAWS) / len(table)
    times = np.empty((DRAWS, table.shape[1]))  # how often each episode is drawn
    for indices in tasks:
        times[:, indices] = rng.multinomial(len(indices), np.full(len(indices), 1 / len(indices)), DRAWS)
    found: Array = np.einsum("ds,se,de,e->d", seeds, table, times, weights, optimize=True)
    return found
