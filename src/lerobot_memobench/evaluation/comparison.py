"""Two evaluations of the same episodes, compared pair by pair, with tests of each difference.

Episodes are paired by task, number and referent. Rates are fractions.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lerobot_memobench.envs.episode_log import OF_THE_POLICY, differences
from lerobot_memobench.envs.settings import SETTINGS
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.metrics import METRICS, Record, by_task, operations, policy_inputs, value_of
from lerobot_memobench.evaluation.records import APART, Run, other_physics
from lerobot_memobench.evaluation.report_tables import AVERAGE, inputs_phrase
from lerobot_memobench.evaluation.statistics import PERMUTATIONS, detectable, holm, mcnemar, sign_flip
from lerobot_memobench.evaluation.tables import Cell, Count, Name, Numbers, Report, Section, Table, csv_text, figure
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.task import MEMORY_TYPES

SCENES = "scene_hash"
ALLOWED = (*(name for name in SETTINGS if name not in APART), SCENES)
"""What may differ between both when asked for by name."""

Pair = tuple[Record, Record]


# --- pairs of rollouts ---


def common_episodes(a: Run, b: Run, allow: Collection[str] = ()) -> list[Pair]:
    """Return the episodes that both hold: same task, number and referent.

    Args:
        allow: which of `ALLOWED` may differ.

    Raises:
        MemobenchError: there are none, or a pair differs in its checkpoints.
    """

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
    for mine, other in pairs:
        if operations(mine) != operations(other):
            raise MemobenchError(
                f"{mine['task']!r} has other checkpoints in {a.folder} ({operations(mine)}) than in {b.folder} "
                f"({operations(other)}); compare evaluations of one version of the task"
            )
    return pairs


def unlike_pairs(pairs: Sequence[Pair], allow: Collection[str]) -> dict[str, str]:
    """Return what makes an episode and differs in pairs: the name that allows it -> it in words.

    A side that does not tell it does not differ. Other seeds have other scenes, which need no name of their own.
    """
    for field, name, what in (
        ("seed", "seed_base", "seeds"),
        ("scene_hash", SCENES, "initial scenes"),
        ("variant", "referent", "variants"),
    ):
        different = [(x, y) for x, y in pairs if None not in (x.get(field), y.get(field)) and x[field] != y[field]]
        if different and not {name, "seed_base"} & set(allow):
            x, y = different[0]
            return {
                name: f"{len(different)} of {len(pairs)} pairs do not have the same {what}, the first is {x['task']}, "
                f"episode {x['episode']} ({field} {x[field]} and {y[field]})"
            }
    return {}


# --- differences ---


@dataclass(frozen=True)
class Difference:
    """One metric of both evaluations over the same pairs. Rates are fractions.

    Attributes:
        scope: "average", a memory type, or a task.
        metric: SR, MSR, MUR or MCR.
        n: pairs.
        a: rate of the first evaluation.
        b: rate of the second.
        p: exact McNemar for SR, sign-flip permutation else.
        exact: whether every assignment of signs was looked at.
        adjusted: p after Holm over the tasks, None but for tasks.
        detectable: smallest true difference that so many pairs show with 80 % power at 5 %; None for above 1.
        only_a: pairs in which only the first succeeded (SR only).
        only_b: pairs in which only the second did (SR only).
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
    """Both evaluations' names, number of pairs, all differences, what a reader must know, each one's inputs, and the
    report's first line."""

    a: str
    b: str
    pairs: int
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    inputs: tuple[str, str]
    headline: str


def compare(
    a: Run,
    b: Run,
    *,
    allow: Collection[str] = (),
    seed: int = 0,
    permutations: int = PERMUTATIONS,
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
    notes = tuple(_notes(a, b, len(pairs)))
    a, b = (replace(run, records=[pair[k] for pair in pairs]) for k, run in enumerate((a, b)))
    inputs = (policy_inputs(a.records), policy_inputs(b.records))
    return Comparison(a.name, b.name, len(pairs), tuple(_adjusted(rows)), notes, inputs, headline([a, b]))


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
        reasons = "; ".join([*found, *unlike.values(), *other_physics(a, b)])
        raise MemobenchError(
            f"{a.folder} and {b.folder} are not of the same episodes under one protocol "
            f"({reasons}), so their difference is not the policies' alone; evaluate again"
            + (f", or name what is meant to differ: {options}" if set(names) <= set(ALLOWED) else "")
        )
    return pairs


def _notes(a: Run, b: Run, pairs: int) -> list[str]:
    """Return what a reader must know: what differs, what was left out, what the logs lack."""
    notes = [f"compared although {note}" for note in differences(a.protocol, b.protocol)] + other_physics(a, b)
    left = {run.name: len(run.records) - pairs for run in (a, b)}
    notes += [f"{count_of(count, 'episode')} only in {name} left out" for name, count in left.items() if count]
    return notes + [f"{run.name}: {note}" for run in (a, b) for note in run.notes]


def _scopes(pairs: Sequence[Pair]) -> dict[str, dict[str, list[Pair]]]:
    """Return scope -> task -> pairs: the average, each memory type, each task, in the report's order."""
    tasks: dict[str, list[Pair]] = {}
    for pair in pairs:
        tasks.setdefault(pair[0]["task"], []).append(pair)
    scopes = {AVERAGE: tasks}
    for memory_type in MEMORY_TYPES:
        members = {name: group for name, group in tasks.items() if group[0][0]["memory_type"] == memory_type}
        if members:
            scopes[memory_type] = members
    return scopes | {name: {name: tasks[name]} for name in by_task(mine for mine, _ in pairs)}


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
    smallest = detectable(d, weights)
    if metric == "SR":
        only_a, only_b = int(np.sum(d < 0)), int(np.sum(d > 0))
        p = mcnemar(only_a, only_b)
        return Difference(scope, metric, len(d), a, b, p, True, smallest, only_a, only_b)
    p, exact = sign_flip(d, weights, rng, permutations)
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
        for k, p in zip(places, holm([rows[k].p for k in places]), strict=True):
            result[k] = replace(result[k], adjusted=p)
    return result


# --- the report ---

NOTE = (
    "Difference is the second less the first, in points. p: exact McNemar for SR (pairs of which only one succeeded "
    "are given as first / second), sign-flip permutation for the others; for tasks also adjusted for their number "
    "(Holm). "
    "Detectable: the smallest true difference that so many pairs would show with 80 % power at 5 %."
)


def comparison_report(found: Comparison) -> Report:
    """Return a comparison as tables and JSON values."""
    overall = [row for row in found.differences if not row.of_a_task]
    by_task = [row for row in found.differences if row.of_a_task]
    tables = (
        _table("difference", "Average and memory types", found, overall, tasks=False),
        _table("difference-tasks", "Tasks", found, by_task, tasks=True),
    )
    sentence = f"{count_of(found.pairs, 'episode')} in both, paired by task, episode and referent."
    data = {
        "a": found.a,
        "b": found.b,
        "inputs": {found.a: found.inputs[0], found.b: found.inputs[1]},
        "pairs": found.pairs,
        "differences": [_entry(row) for row in found.differences],
        "notes": list(found.notes),
    }
    return Report(
        f"{found.b} against {found.a}: {found.headline}", (Section("", tables, (sentence, NOTE), found.notes),), data
    )


def comparison_csv(found: Comparison) -> str:
    """Return all differences of a comparison as CSV, one a row."""
    entries = [_entry(row) for row in found.differences]
    return csv_text([list(entry.values()) for entry in entries], list(entries[0]))


def _table(key: str, title: str, found: Comparison, rows: Sequence[Difference], tasks: bool) -> Table:
    header = ["task" if tasks else "scope", "metric", "pairs", found.a, found.b, "difference", "only one", "p"]
    header += ["p (Holm)"] * tasks + ["detectable"]
    starts = [k for k, row in enumerate(rows) if k == 0 or rows[k - 1].scope != row.scope]
    cells = tuple(_row(row, tasks, k in starts) for k, row in enumerate(rows))
    inputs = "; ".join(
        f"{name}: {inputs_phrase(words)}" for name, words in zip((found.a, found.b), found.inputs, strict=True)
    )
    return Table(key, title, tuple(header), cells, note=f"{inputs}.", rules=frozenset(starts) - {0})


def _row(row: Difference, tasks: bool, first: bool) -> tuple[Cell, ...]:
    """Return the row of one metric; only the first of a scope names it."""
    name: Cell = (Name(row.scope) if tasks else row.scope) if first else ""
    return (
        name,
        row.metric,
        Count(row.n),
        _points(row.a),
        _points(row.b),
        _points(row.value, True),
        Numbers("" if row.only_a is None else f"{row.only_a} / {row.only_b}"),
        _p(row.p),
        *[_p(row.adjusted)] * tasks,
        Numbers("> 100") if row.detectable is None else _points(row.detectable),
    )


def _points(value: float, signed: bool = False) -> Numbers:
    return Numbers(figure(value, signed).replace("-", "−"))


def _p(value: float | None) -> Numbers:
    if value is None:
        return Numbers("")
    return Numbers("< 0.001" if value < 0.001 else f"{value:.3f}")


def _entry(row: Difference) -> dict[str, Any]:
    """Return a difference as JSON values; rates in per cent, p as they are."""
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
