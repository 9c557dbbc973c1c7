"""Success of each arm, of its failures those at a wrong referent, order, place or count, and differences between arms.

A difference pairs the same episodes, over all training seeds. Its interval is of a bootstrap that draws training seeds
and, within each task, episodes: a difference that depends on how a training began is not a difference of arms. It is at
least as wide as so few episodes allow (`statistics`). With few training seeds it is still too narrow. The test of
episodes holds for these trainings only, that of training seeds for trainings at large; the table has both.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import ttest_1samp

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Rate, Record, by_task, mean_rate, success_rate, wilson
from lerobot_memobench.evaluation.statistics import (
    DRAWS,
    Array,
    Estimate,
    detectable,
    difference_interval,
    holm,
    percentiles,
    sign_flip,
)
from lerobot_memobench.tasks.failures import REFERENCE_DRIFT, WRONG_ORDER
from lerobot_memobench.tasks.task import MEMORY_TYPES, STRICT_FAILURES
from research.drawing import pyplot, save
from research.learning.experiments import MEMORY
from research.learning.stages import Costs

Runs = Sequence[Sequence[Record]]
"""Rollouts of an arm: per training seed, in the same order of seeds for all arms."""


@dataclass(frozen=True)
class Contrast:
    """An arm's success less that of the reference, averaged as the report averages; fractions.

    Attributes:
        low, high: 95 % interval over training seeds and episodes.
        p: of sign flips of the episodes' differences, each the mean over training seeds; adjusted for the number of
            arms (Holm) by `adjusted`.
        episodes: how many were paired.
        detectable: smallest true difference that so many episodes show with 80 % power at 5 %; None above 1.
        of_seeds: the difference of each training seed.
        p_of_seeds: of a paired t test over them, adjusted alike; None of fewer than three.
    """

    value: float
    low: float
    high: float
    p: float
    episodes: int
    detectable: float | None
    of_seeds: tuple[float, ...]
    p_of_seeds: float | None


def contrasts(arms: Mapping[str, Runs], reference: str) -> dict[str, Contrast]:
    """Return every other arm's difference from the reference, by as many training seeds as both have.

    Raises:
        MemobenchError: arms have not rolled out the same episodes.
    """
    return adjusted(
        {name: contrast(runs, arms[reference], name, reference) for name, runs in arms.items() if name != reference}
    )


def contrast(runs: Runs, reference: Runs, name: str = "arm", of_reference: str = "reference") -> Contrast:
    """Return an arm's difference from a reference of the same training seeds; its p are not adjusted.

    Raises:
        MemobenchError: they have not rolled out the same episodes of the same scenes.
    """
    episodes, rng = episodes_of(reference), np.random.default_rng(0)
    weights, tasks = _weights(reference[0], episodes)
    base = _table(reference, episodes, of_reference)
    _check_scenes(runs, reference, name, of_reference)
    gap = _table(runs, episodes, name) - base
    of_seeds = gap @ weights
    return Contrast(
        float(of_seeds.mean()),
        *_interval(gap, weights, tasks, rng, base),
        sign_flip(gap.mean(axis=0), weights, rng)[0],
        len(episodes),
        detectable(gap.mean(axis=0), weights),
        tuple(of_seeds.tolist()),
        _p_of_seeds(of_seeds),
    )


def adjusted(found: Mapping[str, Contrast]) -> dict[str, Contrast]:
    """Return differences whose p are adjusted for how many there are (Holm)."""
    of_episodes = holm([one.p for one in found.values()])
    told = [name for name, one in found.items() if one.p_of_seeds is not None]
    of_seeds = dict(zip(told, holm([found[name].p_of_seeds or 0.0 for name in told]), strict=True))
    return {
        name: replace(one, p=p, p_of_seeds=of_seeds.get(name))
        for (name, one), p in zip(found.items(), of_episodes, strict=True)
    }


def _p_of_seeds(differences: Array) -> float | None:
    """Return the two-sided p of a paired t test; None of fewer than three seeds, or where all are equal: they say
    nothing of how seeds differ.
    """
    if len(differences) < 3 or np.ptp(differences) < 1e-9:
        return None
    return float(ttest_1samp(differences, 0.0).pvalue)


Key = tuple[str, int]


def _key(record: Record) -> Key:
    return str(record["task"]), int(record["seed"])


def episodes_of(runs: Runs) -> list[Key]:
    """Return task and seed of what the first training seed rolled out, in order."""
    return sorted(_key(record) for record in runs[0])


def _check_scenes(runs: Runs, reference: Runs, name: str, of_reference: str) -> None:
    """Refuse episodes whose scene or variant is another one than the reference's, where both tell it."""
    told = ("suite", "referent", "variant", "scene_hash")
    there = {_key(record): record for records in reference for record in records}
    for record in (record for records in runs for record in records):
        other = there.get(_key(record), {})
        for what in told:
            if None not in (a := record.get(what), b := other.get(what)) and a != b:
                raise MemobenchError(
                    f"{record['task']}, seed {record['seed']}: {what} is {a} for {name!r} and {b} for "
                    f"{of_reference!r}; compare rollouts of the same scenes"
                )


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


def average_success(rollouts: Runs) -> Estimate:
    """Return an arm's success, averaged as the report averages, with its 95 % interval over seeds and episodes."""
    episodes = episodes_of(rollouts)
    weights, tasks = _weights(rollouts[0], episodes)
    table = _table(rollouts, episodes, "training seeds")
    value = float((table @ weights).mean())
    low, high = percentiles(_draws(table, weights, tasks, np.random.default_rng(0)))
    least, most = wilson(min(value, 1.0), 1 / float(np.sum(weights**2)))  # an episode counts once, whoever rolls it out
    return Estimate(value, min(low, least), max(high, most))


def _draws(table: Array, weights: Array, tasks: Sequence[Sequence[int]], rng: np.random.Generator) -> Array:
    """Return bootstrap draws of the weighted mean of a table (training seeds, episodes)."""
    seeds = rng.multinomial(len(table), np.full(len(table), 1 / len(table)), DRAWS) / len(table)
    times = np.empty((DRAWS, table.shape[1]))  # how often each episode is drawn
    for places in tasks:
        times[:, places] = rng.multinomial(len(places), np.full(len(places), 1 / len(places)), DRAWS)
    found: Array = np.einsum("ds,se,de,e->d", seeds, table, times, weights, optimize=True)
    return found


def _interval(
    gap: Array, weights: Array, tasks: Sequence[Sequence[int]], rng: np.random.Generator, base: Array
) -> tuple[float, float]:
    """Return the 95 % interval of the weighted mean of differences from ``base`` (training seeds, episodes)."""
    draws = _draws(gap, weights, tasks, rng)
    before = base.mean(axis=0)  # an episode counts once, however many policies were trained
    return difference_interval(draws, before, before + gap.mean(axis=0), weights)


# --- outcomes ---

WRONG = (REFERENCE_DRIFT, WRONG_ORDER, *STRICT_FAILURES)
"""Failures that are a memory's and no hand's: a wrong referent, order, place or count."""


@dataclass(frozen=True)
class Outcome:
    """Rollouts of one arm on one or several tasks, all training seeds together.

    Attributes:
        success: over all rollouts, or the mean of tasks.
        of_seeds: the same of each training seed.
        wrong: rollouts that failed with a wrong referent, order, place or count. others: that failed otherwise.
    """

    success: Rate
    of_seeds: tuple[float, ...]
    wrong: int
    others: int

    @property
    def wrong_share(self) -> float:
        """What share of rollouts failed as ``wrong`` ones, tasks averaged as in ``success``, about."""
        failures = self.wrong + self.others
        return (1 - _value(self.success)) * self.wrong / failures if failures else 0.0


def outcomes_of(rollouts: Runs) -> dict[str, Outcome]:
    """Return "all", memory type and task -> outcome, of an arm's rollouts.

    "all" is the mean over memory types of the mean over tasks, as in the paper.
    """
    runs = [by_task(records) for records in rollouts]
    tasks = list(runs[0])
    found = {task: _outcome([[run[task]] for run in runs]) for task in tasks}
    type_of = {task: str(runs[0][task][0]["memory_type"]) for task in tasks}
    groups = {kind: [task for task in tasks if type_of[task] == kind] for kind in MEMORY_TYPES}
    types: dict[str, Outcome] = {
        kind: _outcome([[run[task] for task in own] for run in runs]) for kind, own in groups.items() if own
    }
    return {"all": _mean(types.values()), **types, **found}


def _outcome(runs: Sequence[Sequence[Sequence[Record]]]) -> Outcome:
    """Put together the rollouts of one or several tasks, (training seed, task, rollout)."""
    tasks = [[record for run in runs for record in run[k]] for k in range(len(runs[0]))]
    failures = [record.get("failure") for group in tasks for record in group if not record["success"]]
    wrong = sum(failure in WRONG for failure in failures)
    return Outcome(
        success=mean_rate([success_rate(group) for group in tasks]),
        of_seeds=tuple(_value(mean_rate([success_rate(group) for group in run])) for run in runs),
        wrong=wrong,
        others=len(failures) - wrong,
    )


def _mean(types: Iterable[Outcome]) -> Outcome:
    types = list(types)
    seeds = zip(*(outcome.of_seeds for outcome in types), strict=True)
    return Outcome(
        success=mean_rate([outcome.success for outcome in types]),
        of_seeds=tuple(sum(values) / len(values) for values in seeds),
        wrong=sum(outcome.wrong for outcome in types),
        others=sum(outcome.others for outcome in types),
    )


def _value(rate: Rate) -> float:
    assert rate.value is not None  # there are rollouts
    return rate.value


def as_json(arms: Mapping[str, Mapping[str, Outcome]]) -> dict[str, Any]:
    """Return arm -> scope -> figures, rates in per cent."""
    return {arm: {scope: _figures(outcome) for scope, outcome in found.items()} for arm, found in arms.items()}


def _figures(outcome: Outcome) -> dict[str, Any]:
    low, high = outcome.success.interval or (None, None)
    return {
        "success": outcome.success.value,
        "interval": [low, high],
        "rollouts": outcome.success.n,
        "of_seeds": list(outcome.of_seeds),
        "wrong": outcome.wrong,
        "wrong_share": outcome.wrong_share,
        "other_failures": outcome.others,
    }


# --- figure ---

COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#7f7f7f")
"""Okabe and Ito's palette, apart for the colour-blind too; one per arm."""
WRONG_COLOUR = "#d55e00"
SCOPES = ("all", *MEMORY_TYPES)


def draw(arms: Mapping[str, Mapping[str, Outcome]], path: Path) -> Path:
    """Draw the means over memory types, or the one task there is, to ``path``; return it.

    Args:
        arms: arm -> scope -> outcome, as `outcomes.outcomes_of` finds them.
    """
    plt = pyplot()
    scopes = scopes_of(next(iter(arms.values())))
    figure, axis = plt.subplots(figsize=(7.0, 0.9 + 0.32 * len(scopes) * len(arms)), constrained_layout=True)
    for row, scope in enumerate(scopes):
        for place, name in enumerate(arms):
            _draw_bar(axis, row + 0.8 * ((place + 0.5) / len(arms) - 0.5), 0.74 / len(arms), arms[name][scope], place)
    axis.set_yticks(range(len(scopes)), [scope.replace("_", " ") for scope in scopes])
    axis.invert_yaxis()
    axis.set_xlim(0, 100)
    axis.set_xlabel("rollouts solved, % (black: 95 % interval)")
    axis.spines[["top", "right"]].set_visible(False)
    handles = [plt.Rectangle((0, 0), 1, 1, color=COLOURS[place % len(COLOURS)]) for place in range(len(arms))]
    handles.append(plt.Rectangle((0, 0), 1, 1, color=WRONG_COLOUR, alpha=0.35))
    labels = [*arms, "failed at a wrong referent, order, place or count"]
    columns = len(labels) if sum(map(len, labels)) < 72 else 2  # what the figure is wide enough for
    figure.legend(handles, labels, loc="outside upper center", ncols=columns, fontsize=9, frameon=False)
    return save(figure, path)


def scopes_of(found: Mapping[str, Outcome]) -> list[str]:
    """Return what is drawn of an arm: the mean and the memory types; of one task, that task."""
    types = [scope for scope in SCOPES if scope in found]
    tasks = [scope for scope in found if scope not in SCOPES]
    return tasks if len(tasks) == 1 else types


def _draw_bar(axis: Any, at: float, height: float, outcome: Outcome, place: int) -> None:
    """Draw one arm: solved, what was wrong behind it, and the interval of the first."""
    solved = 100 * (outcome.success.value or 0.0)
    low, high = (100 * bound for bound in outcome.success.interval or (0.0, 0.0))
    axis.barh(at, solved, height, color=COLOURS[place % len(COLOURS)])
    axis.barh(at, 100 * outcome.wrong_share, height, left=solved, color=WRONG_COLOUR, alpha=0.35)
    axis.plot([low, high], [at, at], color="black", linewidth=1.2)
    axis.text(1, at, f"{solved:.0f}", va="center", fontsize=8, color="white" if solved > 6 else "black")


# --- tables in Markdown ---

COLUMNS = (
    *("", "rollouts", "success", "95 % interval", "training seeds"),
    *("wrong referent, order, place or count", "other failures"),
)


def outcomes_table(arms: Mapping[str, Mapping[str, Outcome]]) -> str:
    """Return a table of all arms and scopes; a mean over several tasks comes before its tasks."""
    scopes = list(next(iter(arms.values())))
    tasks = [scope for scope in scopes if scope not in SCOPES]
    told = tasks if len(tasks) == 1 else scopes
    rows = [[f"{scope}, {arm}", *_cells(arms[arm][scope])] for scope in told for arm in arms]
    return markdown(COLUMNS, rows)


def _cells(outcome: Outcome) -> list[str]:
    low, high = outcome.success.interval or (0.0, 0.0)
    value = outcome.success.value or 0.0
    seeds = ", ".join(f"{100 * each:.0f}" for each in outcome.of_seeds)
    rates = [f"{100 * value:.1f}", f"{100 * low:.1f}–{100 * high:.1f}"]
    return [str(outcome.success.n), *rates, seeds, str(outcome.wrong), str(outcome.others)]


def contrasts_table(found: Mapping[str, Contrast], reference: str = MEMORY) -> str:
    """Return a table of arms against the reference."""
    rows = [
        [
            f"{name} minus {reference}",
            str(one.episodes),
            *(f"{100 * one.value:+.1f}", f"{100 * one.low:+.1f} to {100 * one.high:+.1f}", _probability(one.p)),
            ", ".join(f"{100 * each:+.0f}" for each in one.of_seeds),
            _probability(one.p_of_seeds),
            "–" if one.detectable is None else f"{100 * one.detectable:.1f}",
        ]
        for name, one in found.items()
    ]
    tests = ("p of episodes (Holm)", "of training seeds", "p of training seeds (Holm)")
    return markdown(("", "episodes", "difference, points", "95 %", *tests, "detectable"), rows)


def _probability(p: float | None) -> str:
    if p is None:
        return "–"
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def costs_table(costs: Costs) -> str:
    """Return what each part took: minutes of the longest command of a part, and of processors in all."""
    rows = []
    for part, commands in costs.items():
        told = [cost for cost in commands if cost is not None]
        wall = max((cost.wall_s for cost in told), default=0.0)
        rows.append([part, str(len(told)), f"{wall / 60:.1f}", f"{sum(cost.cpu_s for cost in told) / 60:.1f}"])
    return markdown(("part", "commands", "longest, min", "CPU min in all"), rows)


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))
