"""Two evaluations of the same episodes, compared pair by pair: rates, differences with intervals, and tests.

Episodes are paired by task, number and referent. Rates are fractions. Evaluations that differ on purpose in the setting
of a control of memory (`CONTROLS`) are that control: the setting may differ, and the report explains the difference.
Other controls are evidence, which needs one evaluation (`evidence`), and granularity (`report`).
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import permutations as ordered
from typing import Any

import numpy as np

from lerobot_memobench.envs.evaluation_file import OF_ONE_EVALUATION, POLICY, differences
from lerobot_memobench.envs.settings import INTACT, SETTINGS
from lerobot_memobench.errors import MemobenchError, count_of, nearest
from lerobot_memobench.evaluation.metrics import MEMORY_TYPE, SUITE, Record, inputs_phrase, operations, percent
from lerobot_memobench.evaluation.records import SCENES, Run, headline, other_draws, other_hashes, other_physics
from lerobot_memobench.evaluation.statistics import PERMUTATIONS, Contrast, Estimate, Kind, Pair, contrasts_of
from lerobot_memobench.evaluation.tables import (
    NOT_APPLICABLE,
    Cell,
    Name,
    Numbers,
    Report,
    Section,
    Table,
    percent_text,
    with_ids,
)
from lerobot_memobench.tasks.catalogue import libero_id

ALLOWED = (*(name for name in SETTINGS if name != "suite"), SCENES)
"""Settings that may differ when `allow` names them."""


# --- controls ---


@dataclass(frozen=True)
class Control:
    """A setting in which two evaluations differ on purpose.

    Attributes:
        setting: key of the protocol, or of the policy's settings where ``of_policy``.
        default: its value in the first evaluation; the second has another.
        meaning: how to read the difference.
        one_policy: whether both evaluations have to be of one policy.
        gap_closed: whether `oracle_share` is reported.
        by_checkpoint: whether prefix completion is compared checkpoint by checkpoint.
        value: the setting's only value that is the control; None: every value but the default.
        also: other settings of the control, which may differ as well.
    """

    title: str
    setting: str
    default: Any
    meaning: str
    of_policy: bool = False
    one_policy: bool = False
    gap_closed: bool = False
    by_checkpoint: bool = False
    value: Any = None
    also: tuple[str, ...] = ()

    def value_in(self, run: Run) -> Any:
        """Return the setting's value in an evaluation, the default where its log does not record it."""
        known = run.protocol[POLICY].get("settings", {}) if self.of_policy else run.protocol
        value = known.get(self.setting, self.default)
        return value if self.value in (None, value) else self.default


CONTROLS = (
    Control(
        "Pauses",
        "pause_steps",
        0,
        "The robot rests at times that the seed draws. The policy observes and does the same, only later. A policy "
        "that reads a clock loses; a policy that remembers events does not.",
        one_policy=True,
    ),
    Control(
        "Slower actions",
        "speed",
        1.0,
        "Each action takes longer, so all events happen later. A policy that reads a clock loses; a policy that "
        "remembers events loses no more than the expert.",
        one_policy=True,
    ),
    Control(
        "Corrupted memory",
        "corrupt",
        INTACT,
        "The memory of the second evaluation's policy was deleted, swapped or made noisy once, at corrupt_step. "
        "Metrics that do not fall do not depend on the memory before that step. With reshow the evidence was shown "
        "again: a policy that recovers falls less than without it.",
        one_policy=True,
        also=("corrupt_step", "reshow"),
    ),
    Control(
        "Prompt shown again",
        "reshow",
        False,
        "The demonstration prompt plays twice in the second evaluation. After a corruption of the memory, a gain is "
        "the policy's recovery; without one, a change is the effect of the longer prompt alone.",
        one_policy=True,
    ),
    Control(
        "Interference",
        "interference",
        0,
        "In the second evaluation the policy observes episodes of other tasks between prompt and execution, without "
        "a reset. A memory of the latest frames loses the prompt; a memory that selects by the task keeps it.",
        one_policy=True,
    ),
    Control(
        "Oracle memory",
        "oracle_memory",
        False,
        "The second policy reads the true memory content. Gap closed is (second − first) / (100 − first): the share "
        "that a perfect memory would recover. It is left out where the gap is under one point.",
        gap_closed=True,
    ),
    Control(
        "Shuffled memory",
        "align_targets",
        "subgoals",
        "The second policy was trained on subgoals in another order; tasks with fewer than three such subgoals on "
        "subgoals of other episodes. c1, c2, … count rollouts in which that checkpoint and all before it were "
        "satisfied.",
        of_policy=True,
        by_checkpoint=True,
        value="shuffled",
    ),
)


def control_between(a: Run, b: Run) -> Control | None:
    """Return the control that two evaluations are, None where none of `CONTROLS` differs.

    Raises:
        MemobenchError: the evaluation with the control comes first, or they are of two policies.
    """
    for control in CONTROLS:
        first, second = control.value_in(a), control.value_in(b)
        if first == second:
            continue
        if first != control.default:
            raise MemobenchError(
                f"{a.folder} was evaluated with {control.setting}={first} and {b.folder} with {control.setting}="
                f"{second}; expected the evaluation with {control.setting}={control.default} first: exchange them"
            )
        for key in ("type", "sha256") if control.one_policy else ():
            of_a, of_b = (run.protocol[POLICY].get(key) for run in (a, b))
            if of_a and of_b and of_a != of_b:  # an unknown policy may be the same
                raise MemobenchError(
                    f"{a.folder} and {b.folder} are of two policies ({key} {str(of_a)[:12]} and {str(of_b)[:12]}); "
                    "expected one policy with and without the control"
                )
        return control
    return None


# --- pairs of rollouts ---


def _paired(a: Run, b: Run, allow: Collection[str]) -> list[Pair]:
    """Return the episodes that both hold; raise where a setting differs that ``allow`` lacks, naming all of them."""
    for name in allow:
        if name not in ALLOWED:
            raise MemobenchError(
                f"found --allow {name!r}, expected a setting of the protocol, {nearest(name, ALLOWED)}"
            )
    unlike = differences(a.protocol, b.protocol, ignore={*OF_ONE_EVALUATION, *allow})
    names = [difference.split(":")[0] for difference in unlike]
    pairs = _common_episodes(a, b)
    unlike_episodes = _unlike_episodes(pairs, {*allow, *names})
    if unlike or unlike_episodes:
        names += unlike_episodes
        options = " ".join(f"--allow {name}" for name in names)
        reasons = "; ".join([*unlike, *unlike_episodes.values(), *other_physics(a, b)])
        raise MemobenchError(
            f"{a.folder} and {b.folder} are not of the same episodes under one protocol "
            f"({reasons}), so their difference is not the policies' alone; evaluate again"
            + (f", or name the settings that are meant to differ: {options}" if set(names) <= set(ALLOWED) else "")
        )
    return pairs


def _common_episodes(a: Run, b: Run) -> list[Pair]:
    redrawn = other_draws(a, b)  # another salt gives an episode another variant

    def key(record: Record) -> tuple[str, int, int | None]:
        return record["task"], record["episode"], record.get("variant") if redrawn else None

    records_b = {key(record): record for record in b.records}
    pairs = [(record, records_b[key(record)]) for record in a.records if key(record) in records_b]
    if not pairs:
        raise MemobenchError(
            f"{a.folder} and {b.folder} have no episode in common; expected evaluations of the same tasks, episodes "
            "and referent"
        )
    for first, second in pairs:
        if operations(first) != operations(second):
            raise MemobenchError(
                f"{first['task']!r} has other checkpoints in {a.folder} ({operations(first)}) than in {b.folder} "
                f"({operations(second)}); compare evaluations of one version of the task"
            )
    return pairs


def _unlike_episodes(pairs: Sequence[Pair], allow: Collection[str]) -> dict[str, str]:
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


def _notes(a: Run, b: Run, pairs: Sequence[Pair], control: Control | None) -> list[str]:
    meant = () if control is None else (control.setting, *control.also)
    notes = [f"compared although {note}" for note in differences(a.protocol, b.protocol, ignore=(*meant, "salt"))]
    notes += other_draws(a, b) + other_physics(a, b) + other_hashes(a.protocol, b.protocol)
    left = {run.name: len(run.records) - len(pairs) for run in (a, b)}
    notes += [f"{count_of(count, 'episode')} only in {name} left out" for name, count in left.items() if count]
    if paused := [record["paused_steps"] for _, record in pairs if "paused_steps" in record]:
        notes.append(f"a rollout of {b.name} holds {sum(paused) / len(paused):.1f} steps of pauses on average")
    return notes + [f"{run.name}: {note}" for run in (a, b) for note in run.notes]


# --- comparison ---


@dataclass(frozen=True)
class Comparison:
    """Two evaluations over the episodes that both hold.

    Attributes:
        runs: both, with these episodes alone.
        control: the control that they are, if any.
    """

    runs: tuple[Run, Run]
    contrasts: Sequence[Contrast]
    notes: Sequence[str]
    control: Control | None = None

    @property
    def pairs(self) -> int:
        """The number of common episodes."""
        return len(self.runs[0].records)

    @property
    def inputs(self) -> dict[str, str]:
        """Name of an evaluation -> inputs of its policy."""
        return {run.name: inputs_phrase(run.records) for run in self.runs}

    @property
    def title(self) -> str:
        """The control, where it is one, and the names of both."""
        names = f"{self.runs[1].name} against {self.runs[0].name}"
        return f"{self.control.title}: {names}" if self.control else names


def compare_evaluations(
    a: Run, b: Run, *, allow: Collection[str] = (), seed: int = 0, permutations: int = PERMUTATIONS
) -> Comparison:
    """Compare two evaluations over the episodes that both hold.

    Args:
        allow: settings, of `ALLOWED`, that are meant to differ; a control's setting always may.
        seed: of the random signs.

    Raises:
        MemobenchError: the protocols differ in something else, or no episode is in both.
    """
    control = control_between(a, b)
    allowed = {*allow, *([] if control is None or control.of_policy else [control.setting, *control.also])}
    if other_hashes(a.protocol, b.protocol):
        allowed.add(SCENES)  # two versions hash the same scene differently
    pairs = _paired(a, b, allowed)
    reported = {} if control is None else {"by_checkpoint": control.by_checkpoint, "closes": control.gap_closed}
    contrasts = contrasts_of(pairs, np.random.default_rng(seed), permutations, **reported)
    first, second = (replace(run, records=[pair[k] for pair in pairs]) for k, run in enumerate((a, b)))
    return Comparison((first, second), contrasts, _notes(a, b, pairs, control), control)


def controls_among(runs: Sequence[Run]) -> Iterator[Comparison]:
    """Yield the comparison of each two evaluations that differ only in the setting of a control."""
    for a, b in ordered(runs, 2):
        with suppress(MemobenchError):  # reversed, of two policies, or of other protocols: no control
            if control_between(a, b) is not None:
                yield compare_evaluations(a, b)


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


def comparison_report(comparison: Comparison, overall: bool = False) -> Report:
    """Return a comparison as tables and JSON values; ``overall`` leaves tasks and families out."""
    shown = TABLES[: 1 if overall else None]
    kinds = {contrast.kind for contrast in comparison.contrasts}
    tables = [_table(comparison, *spec) for spec in shown if kinds & {*spec[2]}]
    if MEMORY_TYPE not in kinds:
        tables[0] = replace(tables[0], title="Average and suites" if SUITE in kinds else "Suite")
    sentence = f"{count_of(comparison.pairs, 'episode')} in both, paired by task, episode and referent."
    meaning = [comparison.control.meaning] if comparison.control else []
    title = comparison.title if overall else ""
    section = Section(title, tables, [sentence, *meaning, NOTE], comparison.notes)
    data = {
        "a": comparison.runs[0].name,
        "b": comparison.runs[1].name,
        "control": comparison.control.setting if comparison.control else None,
        "inputs": comparison.inputs,
        "pairs": comparison.pairs,
        "differences": [_entry(row) for row in comparison.contrasts if any(row.kind in spec[2] for spec in shown)],
        "notes": list(comparison.notes),
    }
    return Report(f"{comparison.title}: {headline(comparison.runs)}", [section], data)


def comparison_phrase(comparison: Comparison) -> str:
    """Return the change of the average success in words, for one line."""
    success = comparison.contrasts[0]
    return f"{comparison.title}: SR {_points(success.value, True)} {_interval(success)}"


def _table(comparison: Comparison, key: str, title: str, kinds: Collection[Kind]) -> Table:
    rows = [row for row in comparison.contrasts if row.kind in kinds]
    of_tasks, closes = "task" in kinds, any(row.closed is not None for row in rows)
    columns: list[tuple[str, Callable[[Contrast], Cell]]] = [
        ("metric", lambda row: row.metric),
        ("pairs", lambda row: row.n),
        (comparison.runs[0].name, lambda row: _points(row.a)),
        (comparison.runs[1].name, lambda row: _points(row.b)),
        ("difference", lambda row: _points(row.value, True)),
        ("95 %", lambda row: Numbers(_interval(row))),
        ("only one", lambda row: Numbers("" if row.only_a is None else f"{row.only_a} / {row.only_b}")),
        ("p", lambda row: _p(row.p)),
        *[("p (Holm)", lambda row: _p(row.adjusted))] * of_tasks,
        ("detectable", lambda row: Numbers("> 100") if row.detectable is None else _points(row.detectable)),
        *[("gap closed", lambda row: _share(row.closed))] * closes,
    ]
    starts = [k for k, row in enumerate(rows) if k == 0 or rows[k - 1].scope != row.scope]
    names = [(Name(row.scope) if of_tasks else row.scope) if k in starts else "" for k, row in enumerate(rows)]
    cells = [[name, *(cell(row) for _, cell in columns)] for name, row in zip(names, rows, strict=True)]
    header = ["task" if of_tasks else "scope", *(name for name, _ in columns)]
    note = "; ".join(f"{name}: policy inputs: {words}" for name, words in comparison.inputs.items())
    return with_ids(Table(key, title, header, cells, note=f"{note}.", rules=starts[1:]))


def _points(value: float, signed: bool = False) -> Numbers:
    return Numbers(percent_text(value, signed).replace("-", "−"))


def _interval(row: Contrast) -> str:
    low, high = (_points(bound, True) for bound in row.interval)
    return f"[{low}, {high}]"


def _share(share: Estimate | None) -> Numbers:
    if share is None or share.value is None:
        return Numbers(NOT_APPLICABLE)
    if share.low is None or share.high is None:
        return _points(share.value)
    return Numbers(f"{_points(share.value)} [{_points(share.low)}, {_points(share.high)}]")


def _p(value: float | None) -> Numbers:
    if value is None:
        return Numbers("")
    return Numbers("< 0.001" if value < 0.001 else f"{value:.3f}")


def _entry(row: Contrast) -> dict[str, Any]:
    """Return a difference as JSON values; rates in per cent, p as they are."""
    number, closed = libero_id(row.scope), {}
    if row.closed is not None:
        closed = {"gap_closed": row.closed.value, "gap_closed_low": row.closed.low, "gap_closed_high": row.closed.high}
    return {
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
        **{name: percent(value) for name, value in closed.items()},
    }
