"""Two evaluations of the same episodes, compared pair by pair."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.comparison import paired_tests
from lerobot_memobench.evaluation.comparison.pairing import ALLOWED, Pair, common_episodes, unlike_pairs
from lerobot_memobench.evaluation.documents.evaluation_tables import AVERAGE
from lerobot_memobench.evaluation.metrics.rates import METRICS, value_of
from lerobot_memobench.evaluation.metrics.rollouts import policy_inputs
from lerobot_memobench.evaluation.records.protocol import OF_THE_POLICY, differences
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.task import MEMORY_TYPES


@dataclass(frozen=True)
class Difference:
    """One metric of both evaluations over the same pairs. Rates are fractions.

    Attributes:
        scope: "average", a memory type, or a task. n: pairs.
        only_a, only_b: pairs in which only one of both succeeded (SR only).
        p: exact McNemar for SR, sign-flip permutation else; exact: whether every assignment of signs was looked at.
        adjusted: p after Holm over the tasks, None but for tasks.
        detectable: smallest true difference that so many pairs show with 80 % power at 5 %; None for above 1.
    """

    scope: str
    metric: str
    n: int
    a: float
    b: float
    p: float
    exact: bool
    detectable: float | None
    only_a: int | None = None
    only_b: int | None = None
    adjusted: float | None = None

    @property
    def value(self) -> float:
        """The second rate less the first."""
        return self.b - self.a

    @property
    def of_a_task(self) -> bool:
        """Whether the scope is a task."""
        return self.scope not in (AVERAGE, *MEMORY_TYPES)


@dataclass(frozen=True)
class Comparison:
    """Both evaluations' names, number of pairs, all differences, what a reader must know, and each one's inputs."""

    a: str
    b: str
    pairs: int
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    inputs: tuple[str, str]


def compare(
    a: Run,
    b: Run,
    *,
    allow: Collection[str] = (),
    seed: int = 0,
    permutations: int = paired_tests.PERMUTATIONS,
) -> Comparison:
    """Compare two evaluations over the episodes that both hold.

    Args:
        allow: settings of the protocol (or "scene_hash") that are meant to differ.
        seed: of the random signs.

    Raises:
        MemobenchError: the protocols differ in something else, or no episode is in both.
    """
    pairs = _like_pairs(a, b, allow)
    rng = np.random.default_rng(seed)
    rows = [
        row
        for scope, members in _scopes(pairs).items()
        for metric in METRICS
        if (row := _difference(scope, metric, members, rng, permutations)) is not None
    ]
    notes, seen = (
        tuple(_notes(a, b, len(pairs))),
        (policy_inputs([mine for mine, _ in pairs]), policy_inputs([other for _, other in pairs])),
    )
    return Comparison(a.name, b.name, len(pairs), tuple(_adjusted(rows)), notes, seen)


def _like_pairs(a: Run, b: Run, allow: Collection[str]) -> list[Pair]:
    """Return the episodes that both hold; raise where anything differs that was not allowed, with all that does."""
    for name in allow:
        if name not in ALLOWED:
            raise MemobenchError(
                f"found --allow {name!r}, expected a setting of the protocol, {nearest(name, ALLOWED)}"
            )
    found = differences(a.protocol, b.protocol, ignore={*OF_THE_POLICY, *allow})
    names = [one.split(":")[0] for one in found]
    pairs = common_episodes(a, b, {*allow, *names})
    unlike = unlike_pairs(pairs, {*allow, *names})
    if found or unlike:
        names += unlike
        options = " ".join(f"--allow {name}" for name in names)
        raise MemobenchError(
            f"{a.folder} and {b.folder} are not of the same episodes under one protocol "
            f"({'; '.join([*found, *unlike.values()])}), so their difference is not the policies' alone; evaluate again"
            + (f", or name what is meant to differ: {options}" if set(names) <= set(ALLOWED) else "")
        )
    return pairs


def _notes(a: Run, b: Run, pairs: int) -> list[str]:
    """Return what a reader must know: what differs, what was left out, what the logs lack."""
    notes = [f"compared although {note}" for note in differences(a.protocol, b.protocol)]
    left = {run.name: len(run.records) - pairs for run in (a, b)}
    notes += [f"{count_of(count, 'episode')} only in {name} left out" for name, count in left.items() if count]
    return notes + [f"{run.name}: {note}" for run in (a, b) for note in run.notes]


def _scopes(pairs: Sequence[Pair]) -> dict[str, dict[str, list[Pair]]]:
    """Return scope -> task -> pairs: the average, each memory type, each task, in the report's order."""
    tasks: dict[str, list[Pair]] = {}
    types: dict[str, str] = {}
    for pair in pairs:
        tasks.setdefault(pair[0]["task"], []).append(pair)
        types[pair[0]["task"]] = pair[0]["memory_type"]
    scopes = {AVERAGE: tasks}
    for memory_type in MEMORY_TYPES:
        members = {name: group for name, group in tasks.items() if types[name] == memory_type}
        if members:
            scopes[memory_type] = members
    order: dict[str, int] = {name: k for k, name in enumerate(MEMORY_TYPES)}
    for name in sorted(tasks, key=lambda task: (order.get(types[task], len(order)), task)):
        scopes[name] = {name: tasks[name]}
    return scopes


# --- one metric in one scope ---


def _difference(
    scope: str, metric: str, tasks: Mapping[str, Sequence[Pair]], rng: np.random.Generator, permutations: int
) -> Difference | None:
    """Return the difference of one metric in one scope, weighed as the report weighs; None where not applicable."""
    groups = _values(metric, tasks)
    if not groups:
        return None
    table = np.array([pair for group in groups for values in group for pair in values])
    weights = np.array(
        [1 / (len(groups) * len(group) * len(values)) for group in groups for values in group for _ in values]
    )
    a, b = (
        _mean([_mean([_mean([pair[k] for pair in values]) for values in group]) for group in groups]) for k in (0, 1)
    )
    d = table[:, 1] - table[:, 0]
    smallest = paired_tests.detectable(d, weights)
    if metric == "SR":
        only_a, only_b = int(np.sum(d < 0)), int(np.sum(d > 0))
        p = paired_tests.mcnemar(only_a, only_b)
        return Difference(scope, metric, len(d), a, b, p, True, smallest, only_a, only_b)
    p, exact = paired_tests.sign_flip(d, weights, rng, permutations)
    return Difference(scope, metric, len(d), a, b, p, exact, smallest)


def _values(metric: str, tasks: Mapping[str, Sequence[Pair]]) -> list[list[list[tuple[float, float]]]]:
    """Return memory types of tasks of what both rollouts of a pair give to a metric, where it applies."""
    groups: dict[str, list[list[tuple[float, float]]]] = {}
    for pairs in tasks.values():
        values = [
            (x, y)
            for mine, other in pairs
            if (x := value_of(mine, metric)) is not None and (y := value_of(other, metric)) is not None
        ]
        if values:
            groups.setdefault(pairs[0][0]["memory_type"], []).append(values)
    return list(groups.values())


def _mean(values: Sequence[float]) -> float:
    """Return the mean as the report computes it, so that both print the same digits."""
    return sum(values) / len(values)


def _adjusted(rows: Sequence[Difference]) -> list[Difference]:
    """Adjust the p-values of the tasks, per metric, for their number."""
    result = list(rows)
    for metric in METRICS:
        places = [k for k, row in enumerate(rows) if row.metric == metric and row.of_a_task]
        for k, p in zip(places, paired_tests.holm([rows[k].p for k in places]), strict=True):
            result[k] = replace(result[k], adjusted=p)
    return result
