"""Two evaluations of the same episodes, compared pair by pair: rates, differences with intervals, and tests.

Episodes are paired by task, number and referent. Rates are fractions. Evaluations that differ in the setting of a
control (`controls`) are that control: the setting may differ, and the report explains the difference.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations as ordered
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.episode_log import OF_ONE_EVALUATION, differences
from lerobot_memobench.envs.settings import SETTINGS
from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.evaluation.agreement import SCENES
from lerobot_memobench.evaluation.controls import Control, control_between, gap_closed, published_table
from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.metrics import (
    MEMORY_TYPE,
    METRICS,
    SUITE,
    Record,
    by_task,
    operations,
    percent,
    policy_inputs,
    prefix,
    satisfied,
    value_of,
    varies,
)
from lerobot_memobench.evaluation.records import APART, Run, other_draws, other_hashes, other_physics
from lerobot_memobench.evaluation.report_tables import inputs_phrase
from lerobot_memobench.evaluation.statistics import (
    DRAWS,
    PERMUTATIONS,
    Array,
    Estimate,
    detectable,
    difference_interval,
    holm,
    mcnemar,
    newcombe,
    percentiles,
    sign_flip,
)
from lerobot_memobench.evaluation.tables import (
    NOT_APPLICABLE,
    Cell,
    Name,
    Numbers,
    Report,
    Section,
    Table,
    csv_text,
    figure,
    with_ids,
)
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.catalogue import GROUPS, get_task, suite_of
from lerobot_memobench.tasks.libero_suites import libero_id
from lerobot_memobench.tasks.task import LIBERO_SUITES, SUITES

ALLOWED = (*(name for name in SETTINGS if name not in APART), SCENES)
"""Settings that may differ when `allow` names them."""

Pair = tuple[Record, Record]


# --- pairs of rollouts ---


def common_episodes(a: Run, b: Run, allow: Collection[str] = ()) -> list[Pair]:
    """Return the episodes that both hold: same task, number and referent; under different salts, same variant too.

    Args:
        allow: which of `ALLOWED` may differ.

    Raises:
        MemobenchError: there are none, or a pair differs in its checkpoints.
    """

    redrawn = other_draws(a, b)

    def key(record: Record) -> tuple[str, int, str, int | None]:
        referent = "" if "referent" in allow else str(record.get("referent", "fixed"))
        return record["task"], record["episode"], referent, record.get("variant") if redrawn else None

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
    """Return the first part of an episode's identity that differs in pairs: setting to allow -> a sentence.

    A missing field is no difference. Seeds that differ imply other scenes.
    """
    for field, name, noun in (
        ("seed", "seed_base", "seeds"),
        (SCENES, SCENES, "initial scenes"),
        ("variant", "referent", "variants"),
    ):
        different = [(x, y) for x, y in pairs if None not in (x.get(field), y.get(field)) and x[field] != y[field]]
        if different and not {name, "seed_base"} & set(allow):
            x, y = different[0]
            return {
                name: f"{len(different)} of {len(pairs)} pairs do not have the same {noun}, the first is {x['task']}, "
                f"episode {x['episode']} ({field} {x[field]} and {y[field]})"
            }
    return {}


# --- differences ---

Kind = Literal["average", "memory type", "suite", "task", "family"]


@dataclass(frozen=True)
class Difference:
    """One metric of both evaluations over the same pairs. Rates are fractions.

    Attributes:
        kind: of the scope.
        scope: the average, a memory type or suite of LIBERO, a task, or a family of tasks.
        metric: SR, MSR, MUR or MCR; of a task also c1, c2, …, prefix completion.
        n: pairs.
        a: rate of the first evaluation.
        b: rate of the second.
        interval: 95 % interval of b − a.
        p: exact McNemar for outcomes of yes or no, sign-flip permutation else.
        exact: whether every assignment of signs was tried.
        detectable: smallest true difference that so many pairs show with 80 % power at 5 %; None for above 1.
        only_a: pairs in which only the first succeeded (SR and prefix completion only).
        only_b: pairs in which only the second did (SR and prefix completion only).
        adjusted: p after Holm over the tasks, None but for tasks.
        closed: share of the first's gap to 1 that the second closes; None where the comparison does not ask for it.
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


@dataclass(frozen=True)
class Comparison:
    """Two evaluations over the episodes that both hold.

    Attributes:
        a, b: their names.
        pairs: number of episodes.
        notes: warnings for the reader.
        inputs: of each policy.
        headline: the report's first line.
        control: the control that they are, if any.
    """

    a: str
    b: str
    pairs: int
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]
    inputs: tuple[str, str]
    headline: str
    control: Control | None = None

    @property
    def title(self) -> str:
        """The control, where it is one, and the names of both."""
        names = f"{self.b} against {self.a}"
        return f"{self.control.title}: {names}" if self.control else names


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
        allow: settings of the protocol (or "scene_hash") that are meant to differ; a control's setting always may.
        seed: of the random signs.

    Raises:
        MemobenchError: the protocols differ in something else, or no episode is in both.
    """
    control = control_between(a, b)
    allowed = {*allow, *([] if control is None or control.of_policy else [control.setting, *control.also])}
    if other_hashes(a.protocol, b.protocol):
        allowed.add(SCENES)
    pairs = _like_pairs(a, b, allowed)
    notes = tuple(_notes(a, b, pairs, control))
    a, b = (replace(run, records=[pair[k] for pair in pairs]) for k, run in enumerate((a, b)))
    return Comparison(
        a=a.name,
        b=b.name,
        pairs=len(pairs),
        differences=tuple(_adjusted(list(_differences(pairs, control, seed, permutations)))),
        notes=notes,
        inputs=(policy_inputs(a.records), policy_inputs(b.records)),
        headline=headline([a, b]),
        control=control,
    )


def controls_among(runs: Sequence[Run]) -> Iterator[Comparison]:
    """Yield the comparison of each two evaluations that differ only in the setting of a control."""
    for a, b in ordered(runs, 2):
        try:
            if control_between(a, b) is not None:
                yield compare(a, b)
        except MemobenchError:  # reversed, of two policies, or of other protocols: no control
            continue


def _like_pairs(a: Run, b: Run, allow: Collection[str]) -> list[Pair]:
    """Return the common episodes; raise where a setting differs that was not allowed, naming all of them."""
    for name in allow:
        if name not in ALLOWED:
            raise MemobenchError(
                f"found --allow {name!r}, expected a setting of the protocol, {nearest(name, ALLOWED)}"
            )
    found = differences(a.protocol, b.protocol, ignore={*OF_ONE_EVALUATION, *allow})
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
            + (f", or name the settings that are meant to differ: {options}" if set(names) <= set(ALLOWED) else "")
        )
    return pairs


def _notes(a: Run, b: Run, pairs: Sequence[Pair], control: Control | None) -> list[str]:
    """Return warnings for the reader: differing settings, episodes left out, gaps of the logs."""
    meant = () if control is None else (control.setting, *control.also)
    notes = [f"compared although {note}" for note in differences(a.protocol, b.protocol, ignore=(*meant, "salt"))]
    notes += other_draws(a, b) + other_physics(a, b) + other_hashes(a.protocol, b.protocol)
    left = {run.name: len(run.records) - len(pairs) for run in (a, b)}
    notes += [f"{count_of(count, 'episode')} only in {name} left out" for name, count in left.items() if count]
    if paused := [record["paused_steps"] for _, record in pairs if "paused_steps" in record]:
        notes.append(f"a rollout of {b.name} holds {sum(paused) / len(paused):.1f} steps of pauses on average")
    return notes + [f"{run.name}: {note}" for run in (a, b) for note in run.notes]


# --- tasks and scopes ---


@dataclass(frozen=True)
class _Task:
    """The pairs of one task.

    Attributes:
        values: metric -> its value in both rollouts of each pair, (n, 2) in [0, 1].
        drawn: metric -> mean of each bootstrap draw, (`DRAWS`, 2).
    """

    name: str
    memory_type: str
    family: str | None
    values: Mapping[str, Array]
    drawn: Mapping[str, Array]


def _tasks(pairs: Sequence[Pair], by_checkpoint: bool) -> list[_Task]:
    partners = {id(mine): other for mine, other in pairs}
    rng = np.random.default_rng(0)
    found = []
    for name, group in by_task(mine for mine, _ in pairs).items():
        both = [(mine, partners[id(mine)]) for mine in group]
        values = {metric: _values(both, metric) for metric in METRICS}
        if by_checkpoint:
            reached = np.array([[prefix(satisfied(record)) for record in pair] for pair in both], dtype=float)
            values |= {f"c{k + 1}": reached[:, :, k] for k in range(reached.shape[2])}
        scenes = _scenes(group)
        episodes = scenes[rng.integers(len(scenes), size=(DRAWS, len(scenes)))].reshape(DRAWS, -1)
        family = get_task(name).family if suite_of(name) in SUITES else None
        applicable = {metric: value for metric, value in values.items() if value is not None}
        drawn = {metric: value[episodes].mean(axis=1) for metric, value in applicable.items()}
        found.append(_Task(name, str(group[0]["memory_type"]), family, applicable, drawn))
    return found


def _scenes(group: Sequence[Record]) -> NDArray[np.int64]:
    """Return the rollouts of each scene of a task by their index, (S, V): V is 1 unless each scene has V variants."""
    scenes: dict[Any, list[int]] = {}
    for k, record in enumerate(group):
        scenes.setdefault(record.get("seed") if varies(record) else (k,), []).append(k)
    whole = len({len(scene) for scene in scenes.values()}) == 1
    return np.array(list(scenes.values()) if whole else [[k] for k in range(len(group))])


def _values(pairs: Sequence[Pair], metric: str) -> Array | None:
    """Return a metric in both rollouts of each pair, (n, 2), None where it does not apply to the task."""
    values = [[value_of(record, metric) for record in pair] for pair in pairs]
    return None if any(None in pair for pair in values) else np.array(values, dtype=float)


Scope = tuple[Kind, str, list[list[_Task]]]
"""Kind, name, and groups of tasks: a rate is the mean over groups of means over their tasks."""


def _scopes(tasks: Sequence[_Task]) -> list[Scope]:
    """Return the average, each memory type or suite of LIBERO, each task and each family, in the report's order.

    Of a single suite of LIBERO, the average is that of the suite. LIBERO's tasks have no families.
    """
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


def _differences(pairs: Sequence[Pair], control: Control | None, seed: int, permutations: int) -> Iterator[Difference]:
    rng = np.random.default_rng(seed)
    closes = control is not None and control.gap_closed
    tasks = _tasks(pairs, by_checkpoint=control is not None and control.by_checkpoint)
    for kind, scope, groups in _scopes(tasks):
        metrics = groups[0][0].values if kind == "task" else METRICS
        for metric in metrics:
            applicable = [there for group in groups if (there := [task for task in group if metric in task.values])]
            if applicable:
                found = _difference(kind, scope, metric, applicable, rng, permutations)
                yield replace(found, closed=_closed(found, metric, applicable)) if closes else found


def _difference(
    kind: Kind, scope: str, metric: str, groups: list[list[_Task]], rng: np.random.Generator, permutations: int
) -> Difference:
    """Return the difference of one metric in one scope, weighted as the report weights."""
    pairs, weights = _weighted(groups, metric)
    d = pairs[:, 1] - pairs[:, 0]
    draws = _drawn(groups, metric)
    if metric in METRICS[1:]:
        only_a = only_b = None
        p, exact = sign_flip(d, weights, rng, permutations)
    else:
        only_a, only_b, exact = int(np.sum(d < 0)), int(np.sum(d > 0)), True
        p = mcnemar(only_a, only_b)
    return Difference(
        kind=kind,
        scope=scope,
        metric=metric,
        n=len(d),
        a=_rate(groups, metric, 0),
        b=_rate(groups, metric, 1),
        interval=difference_interval(draws[:, 1] - draws[:, 0], pairs[:, 0], pairs[:, 1], weights),
        p=p,
        exact=exact,
        detectable=detectable(d, weights),
        only_a=only_a,
        only_b=only_b,
    )


def _weighted(groups: list[list[_Task]], metric: str) -> tuple[Array, Array]:
    """Return all pairs of groups of tasks, (n, 2), and the weight of each, (n,)."""
    parts = [
        (values := task.values[metric], np.full(len(values), 1 / (len(groups) * len(group) * len(values))))
        for group in groups
        for task in group
    ]
    return np.concatenate([pairs for pairs, _ in parts]), np.concatenate([weights for _, weights in parts])


def _drawn(groups: list[list[_Task]], metric: str) -> NDArray[np.float64]:
    """Return the rates of each bootstrap draw, (`DRAWS`, 2)."""
    return np.mean([np.mean([task.drawn[metric] for task in group], axis=0) for group in groups], axis=0)


def _rate(groups: list[list[_Task]], metric: str, side: int) -> float:
    """Return a rate summed as the report sums it, so that both print the same digits."""
    return _mean([_mean([_mean(task.values[metric][:, side].tolist()) for task in group]) for group in groups])


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)


def _closed(found: Difference, metric: str, groups: list[list[_Task]]) -> Estimate:
    """Return the share of the gap that is closed, with its interval where the gap seldom vanishes in the draws."""
    value, draws = gap_closed(found.a, found.b), _drawn(groups, metric)
    shares = [share for a, b in draws.tolist() if (share := gap_closed(a, b)) is not None]
    if value is None or len(shares) <= 0.9 * len(draws):
        return Estimate(value)
    pairs, weights = _weighted(groups, metric)
    least, most = (bound / (1.0 - found.a) for bound in newcombe(pairs[:, 0], pairs[:, 1], weights))
    low, high = percentiles(np.array(shares))
    return Estimate(value, min(low, least), min(max(high, most), 1.0))


def _adjusted(rows: Sequence[Difference]) -> list[Difference]:
    """Adjust the p-values of the tasks, per metric, for their number."""
    result = list(rows)
    for metric in METRICS:
        places = [k for k, row in enumerate(rows) if row.metric == metric and row.kind == "task"]
        for k, p in zip(places, holm([rows[k].p for k in places]), strict=True):
            result[k] = replace(result[k], adjusted=p)
    return result


# --- the report ---

NOTE = (
    "Difference is the second minus the first, in points, with the 95 % interval of a bootstrap over pairs, at least "
    "Newcombe's. p: exact McNemar for SR (only one: pairs in which only the first / second succeeded), sign-flip "
    "permutation for the others; for tasks also adjusted for their number (Holm). Detectable: the smallest true "
    "difference that so many pairs would show with 80 % power at 5 %."
)
TABLES: tuple[tuple[str, str, tuple[Kind, ...]], ...] = (
    ("difference", "Average and memory types", ("average", "memory type", "suite")),
    ("difference-tasks", "Tasks", ("task",)),
    ("difference-families", "Families of tasks", ("family",)),
)
"""Key, title, and kinds of scopes of each table."""


def comparison_report(found: Comparison, paper: bool = False) -> Report:
    """Return a comparison as tables and JSON values.

    Args:
        paper: add the published figures of the control.

    Raises:
        MemobenchError: they are asked for, and the paper has none of this comparison.
    """
    section = comparison_section(found)
    if paper:
        published = published_table(found.control) if found.control else None
        if published is None:
            raise MemobenchError(
                "the paper has no figures of this comparison, only of oracle and of shuffled memory; leave out "
                "--with paper"
            )
        section = replace(section, tables=(*section.tables, published))
    title = f"{found.title}: {found.headline}"
    return Report(title, (replace(section, title=""),), comparison_data(found))


def comparison_section(found: Comparison, overall: bool = False) -> Section:
    """Return the tables of a comparison, with a title.

    Args:
        overall: the average and memory types alone.
    """
    kinds = {row.kind for row in found.differences}
    tables = [_table(found, *each) for each in TABLES[: 1 if overall else None] if kinds & {*each[2]}]
    if MEMORY_TYPE not in kinds:
        tables[0] = replace(tables[0], title="Average and suites" if SUITE in kinds else "Suite")
    sentence = f"{count_of(found.pairs, 'episode')} in both, paired by task, episode and referent."
    meaning = [found.control.meaning] if found.control else []
    return Section(found.title, tuple(tables), (sentence, *meaning, NOTE), found.notes)


def comparison_data(found: Comparison, overall: bool = False) -> dict[str, Any]:
    """Return a comparison as JSON values.

    Args:
        overall: the average and memory types alone.
    """
    kinds = [kind for _, _, kinds in TABLES[: 1 if overall else None] for kind in kinds]
    return {
        "a": found.a,
        "b": found.b,
        "control": found.control.setting if found.control else None,
        "inputs": {found.a: found.inputs[0], found.b: found.inputs[1]},
        "pairs": found.pairs,
        "differences": [_entry(row) for row in found.differences if row.kind in kinds],
        "notes": list(found.notes),
    }


def comparison_phrase(found: Comparison) -> str:
    """Return the change of the average success in words, for one line."""
    success = found.differences[0]
    return f"{found.title}: SR {_points(success.value, True)} {_interval(success)}"


def comparison_csv(found: Comparison) -> str:
    """Return all differences of a comparison as CSV, one a row."""
    return csv_text([_entry(row) for row in found.differences])


def _table(found: Comparison, key: str, title: str, kinds: Collection[Kind]) -> Table:
    rows = [row for row in found.differences if row.kind in kinds]
    of_tasks, closes = "task" in kinds, any(row.closed is not None for row in rows)
    header = [
        "task" if of_tasks else "scope",
        "metric",
        "pairs",
        found.a,
        found.b,
        "difference",
        "95 %",
        "only one",
        "p",
    ]
    header += ["p (Holm)"] * of_tasks + ["detectable"] + ["gap closed"] * closes
    starts = [k for k, row in enumerate(rows) if k == 0 or rows[k - 1].scope != row.scope]
    cells = tuple(_row(row, of_tasks, closes, k in starts) for k, row in enumerate(rows))
    inputs = "; ".join(
        f"{name}: {inputs_phrase(words)}" for name, words in zip((found.a, found.b), found.inputs, strict=True)
    )
    return with_ids(Table(key, title, tuple(header), cells, note=f"{inputs}.", rules=frozenset(starts) - {0}))


def _row(row: Difference, of_tasks: bool, closes: bool, first: bool) -> tuple[Cell, ...]:
    """Return the row of one metric; only the first of a scope names it."""
    name: Cell = (Name(row.scope) if of_tasks else row.scope) if first else ""
    return (
        name,
        row.metric,
        row.n,
        _points(row.a),
        _points(row.b),
        _points(row.value, True),
        Numbers(_interval(row)),
        Numbers("" if row.only_a is None else f"{row.only_a} / {row.only_b}"),
        _p(row.p),
        *[_p(row.adjusted)] * of_tasks,
        Numbers("> 100") if row.detectable is None else _points(row.detectable),
        *[_share(row.closed)] * closes,
    )


def _points(value: float, signed: bool = False) -> Numbers:
    return Numbers(figure(value, signed).replace("-", "−"))


def _interval(row: Difference) -> str:
    low, high = (_points(bound, True) for bound in row.interval)
    return f"[{low}, {high}]"


def _share(found: Estimate | None) -> Numbers:
    if found is None or found.value is None:
        return Numbers(NOT_APPLICABLE)
    if found.low is None or found.high is None:
        return _points(found.value)
    return Numbers(f"{_points(found.value)} [{_points(found.low)}, {_points(found.high)}]")


def _p(value: float | None) -> Numbers:
    if value is None:
        return Numbers("")
    return Numbers("< 0.001" if value < 0.001 else f"{value:.3f}")


def _entry(row: Difference) -> dict[str, Any]:
    """Return a difference as JSON values; rates in per cent, p as they are."""
    number = libero_id(row.scope)
    entry = {
        "kind": row.kind,
        "scope": row.scope,
        **({} if number is None else {"id": number}),
        "metric": row.metric,
        "pairs": row.n,
        "a": round(100 * row.a, 2),
        "b": round(100 * row.b, 2),
        "difference": round(100 * row.value, 2),
        "low": percent(row.interval[0]),
        "high": percent(row.interval[1]),
        "only_a": row.only_a,
        "only_b": row.only_b,
        "test": "sign_flip" if row.only_a is None else "mcnemar_exact",
        "exact": row.exact,
        "p": row.p,
        "p_holm": row.adjusted,
        "detectable": None if row.detectable is None else round(100 * row.detectable, 2),
    }
    if row.closed is None:
        return entry
    closed = {"gap_closed": row.closed.value, "gap_closed_low": row.closed.low, "gap_closed_high": row.closed.high}
    return {**entry, **{name: percent(value) for name, value in closed.items()}}
