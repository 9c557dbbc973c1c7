"""Two evaluations of the same episodes, compared pair by pair."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.comparison import paired_tests as paired
from lerobot_memobench.evaluation.documents.report_sections import AVERAGE, count_of
from lerobot_memobench.evaluation.documents.tables import Cell, Count, Name, Numbers, Report, Section, Table
from lerobot_memobench.evaluation.metrics.rates import METRICS, Record, percent, satisfied
from lerobot_memobench.evaluation.records.protocol import SETTINGS, differences
from lerobot_memobench.evaluation.records.runs import Run
from lerobot_memobench.tasks.task import MEMORY_TYPES

SCENES = "scene_hash"
ALLOWED = (*SETTINGS, SCENES)
"""What may differ between both when asked for by name."""

Pair = tuple[Record, Record]


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
        return self.b - self.a


@dataclass(frozen=True)
class Comparison:
    """Both evaluations' names, how many pairs there are, all differences, and what a reader must know."""

    a: str
    b: str
    pairs: int
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]


def compare(
    a: Run,
    b: Run,
    *,
    allow: Collection[str] = (),
    seed: int = 0,
    permutations: int = paired.PERMUTATIONS,
) -> Comparison:
    """Compare two evaluations over the episodes that both hold.

    Args:
        allow: settings of the protocol (or "scene_hash") that are meant to differ.
        seed: of the random signs.

    Raises:
        MemobenchError: the protocols differ in something else, or no episode is in both.
    """
    for name in allow:
        if name not in ALLOWED:
            raise MemobenchError(
                f"found --allow {name!r}, expected a setting of the protocol, {nearest(name, ALLOWED)}"
            )
    found = differences(a.protocol, b.protocol, ignore=set(allow))
    if found:
        raise MemobenchError(
            f"{a.folder} and {b.folder} were not run under one protocol ({'; '.join(found)}), so their difference is "
            "not the policies' alone; evaluate again, or name what is meant to differ: "
            f"--allow {found[0].split(':')[0]}"
        )
    pairs = _pairs(a, b, allow)
    notes = [f"compared although {note}" for note in differences(a.protocol, b.protocol)]
    left = {run.name: len(run.records) - len(pairs) for run in (a, b)}
    notes += [f"{count_of(count, 'episode')} only in {name} left out" for name, count in left.items() if count]
    notes += [f"{run.name}: {note}" for run in (a, b) for note in run.notes]
    rng = np.random.default_rng(seed)
    rows = [
        row
        for scope, members in _scopes(pairs).items()
        for metric in METRICS
        if (row := _difference(scope, metric, members, rng, permutations)) is not None
    ]
    return Comparison(a.name, b.name, len(pairs), tuple(_adjusted(rows)), tuple(notes))


# --- pairs ---


def _pairs(a: Run, b: Run, allow: Collection[str]) -> list[Pair]:
    """Return the episodes that both hold: same task, number and referent."""

    def key(record: Record) -> tuple[str, int, str]:
        referent = "" if "referent" in allow else str(record.get("referent", "fixed"))
        return record["task"], record["episode"], referent

    others = {key(record): record for record in b.records}
    pairs = [(record, others[key(record)]) for record in a.records if key(record) in others]
    if not pairs:
        raise MemobenchError(
            f"{a.folder} and {b.folder} have no episode in common; expected evaluations of the same tasks, episodes "
            "and referent"
        )
    if "seed_base" not in allow:
        _refuse(pairs, "seed", "seed_base", "seeds")
        if SCENES not in allow:
            _refuse(pairs, "scene_hash", SCENES, "initial scenes")
    for mine, other in pairs:
        if _operations(mine) != _operations(other):
            raise MemobenchError(
                f"{mine['task']!r} has other checkpoints in {a.folder} ({_operations(mine)}) than in {b.folder} "
                f"({_operations(other)}); compare evaluations of one version of the task"
            )
    return pairs


def _refuse(pairs: Sequence[Pair], field: str, name: str, what: str) -> None:
    """Refuse pairs that differ in a field that makes an episode; a side that does not tell it does not differ."""
    different = [
        (x, y) for x, y in pairs if x.get(field) is not None and y.get(field) is not None and x[field] != y[field]
    ]
    if different:
        x, y = different[0]
        raise MemobenchError(
            f"{len(different)} of {len(pairs)} pairs do not have the same {what}, the first is {x['task']}, episode "
            f"{x['episode']} ({field} {x[field]} and {y[field]}); these are different episodes. If that is meant: "
            f"--allow {name}"
        )


def _operations(record: Record) -> str:
    return "".join(checkpoint["operation"] for checkpoint in record["checkpoints"])


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


# --- differences ---


def value_of(record: Record, metric: str) -> float | None:
    """Return what a rollout gives to a metric: success, or the share of its operation's checkpoints satisfied."""
    operation = METRICS[metric]
    if operation is None:
        return float(record["success"])
    places = [k for k, checkpoint in enumerate(record["checkpoints"]) if checkpoint["operation"] == operation]
    if not places:
        return None
    done = satisfied(record)
    return sum(done[k] for k in places) / len(places)


def _difference(
    scope: str, metric: str, tasks: Mapping[str, Sequence[Pair]], rng: np.random.Generator, permutations: int
) -> Difference | None:
    """Return the difference of one metric in one scope, weighed as the report weighs; None where not applicable."""
    groups: dict[str, list[list[tuple[float, float]]]] = {}  # memory type -> tasks -> values of the pairs
    for pairs in tasks.values():
        values = [
            (x, y)
            for mine, other in pairs
            if (x := value_of(mine, metric)) is not None and (y := value_of(other, metric)) is not None
        ]
        if values:
            groups.setdefault(pairs[0][0]["memory_type"], []).append(values)
    if not groups:
        return None
    table = np.array([pair for group in groups.values() for values in group for pair in values])
    weights = np.array(
        [1 / (len(groups) * len(group) * len(values)) for group in groups.values() for values in group for _ in values]
    )
    a, b = (
        _mean([_mean([_mean([pair[k] for pair in values]) for values in g]) for g in groups.values()]) for k in (0, 1)
    )
    d = table[:, 1] - table[:, 0]
    smallest = paired.detectable(d, weights)
    if metric == "SR":
        only_a, only_b = int(np.sum(d < 0)), int(np.sum(d > 0))
        p = paired.mcnemar(only_a, only_b)
        return Difference(scope, metric, len(d), a, b, p, True, smallest, only_a, only_b)
    p, exact = paired.sign_flip(d, weights, rng, permutations)
    return Difference(scope, metric, len(d), a, b, p, exact, smallest)


def _mean(values: Sequence[float]) -> float:
    """Return the mean as the report computes it, so that both print the same digits."""
    return sum(values) / len(values)


def _adjusted(rows: Sequence[Difference]) -> list[Difference]:
    """Adjust the p-values of the tasks, per metric, for their number."""
    from dataclasses import replace

    result = list(rows)
    for metric in METRICS:
        places = [k for k, row in enumerate(rows) if row.metric == metric and row.scope not in (AVERAGE, *MEMORY_TYPES)]
        for k, p in zip(places, paired.holm([rows[k].p for k in places]), strict=True):
            result[k] = replace(result[k], adjusted=p)
    return result


# --- what is written ---

NOTE = (
    "Difference is the second less the first, in points. p: exact McNemar for SR (pairs of which only one succeeded "
    "are given as first / second), sign-flip permutation for the others; for tasks also adjusted for their number "
    "(Holm). "
    "Detectable: the smallest true difference that so many pairs would show with 80 % power at 5 %."
)


def report(found: Comparison) -> Report:
    """Return a comparison as tables and JSON values."""
    overall = [row for row in found.differences if row.scope in (AVERAGE, *MEMORY_TYPES)]
    by_task = [row for row in found.differences if row.scope not in (AVERAGE, *MEMORY_TYPES)]
    tables = (
        _table("difference", "Average and memory types", found, overall, tasks=False),
        _table("difference-tasks", "Tasks", found, by_task, tasks=True),
    )
    sentence = f"{count_of(found.pairs, 'episode')} in both, paired by task, episode and referent."
    title = f"{found.b} against {found.a}"
    return Report(title, (Section("", tables, (sentence, NOTE), found.notes),), data(found))


def _table(key: str, title: str, found: Comparison, rows: Sequence[Difference], tasks: bool) -> Table:
    header = ["task" if tasks else "scope", "metric", "pairs", found.a, found.b, "difference", "only one", "p"]
    header += ["p (Holm)"] * tasks + ["detectable"]
    cells: list[tuple[Cell, ...]] = []
    rules = set()
    for k, row in enumerate(rows):
        first = k == 0 or rows[k - 1].scope != row.scope
        if first and k:
            rules.add(k)
        name: Cell = (Name(row.scope) if tasks else row.scope) if first else ""
        only = "" if row.only_a is None else f"{row.only_a} / {row.only_b}"
        line: list[Cell] = [name, row.metric, Count(row.n), _points(row.a), _points(row.b), _points(row.value, True)]
        line += [Numbers(only), _p(row.p)]
        line += [_p(row.adjusted)] * tasks
        line.append(Numbers("> 100") if row.detectable is None else _points(row.detectable))
        cells.append(tuple(line))
    return Table(key, title, tuple(header), tuple(cells), rules=frozenset(rules))


def _points(value: float, signed: bool = False) -> Numbers:
    text = f"{percent(value):{'+' if signed else ''}.1f}"
    return Numbers(text.replace("-", "−"))


def _p(value: float | None) -> Numbers:
    if value is None:
        return Numbers("")
    return Numbers("< 0.001" if value < 0.001 else f"{value:.3f}")


def data(found: Comparison) -> dict[str, Any]:
    """Return a comparison as JSON values; rates in per cent, p as they are."""

    def entry(row: Difference) -> dict[str, Any]:
        return {
            "scope": row.scope,
            "metric": row.metric,
            "pairs": row.n,
            "a": round(100 * row.a, 2),
            "b": round(100 * row.b, 2),
            "difference": round(100 * row.value, 2),
            "only_a": row.only_a,
            "only_b": row.only_b,
            "test": "mcnemar_exact" if row.metric == "SR" else "sign_flip",
            "exact": row.exact,
            "p": row.p,
            "p_holm": row.adjusted,
            "detectable": None if row.detectable is None else round(100 * row.detectable, 2),
        }

    return {
        "a": found.a,
        "b": found.b,
        "pairs": found.pairs,
        "differences": [entry(row) for row in found.differences],
        "notes": list(found.notes),
    }
