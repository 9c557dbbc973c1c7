"""Evidence: share of choices that follow the past, where each scene was run with each variant of its task.

A policy without the past that cannot look before it chooses gives the same answer in all variants of a scene. Its rate
of right answers is the chance (`tasks.assessment.chance`), for any scenes. The terms *warranted choice* and *reliable
pair* are those of the Counterfactual Memory Audit (arXiv 2609.27247).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from lerobot_memobench.errors import MemobenchError, count_of
from lerobot_memobench.evaluation.metrics import Record, by_task, percent, varies, wilson
from lerobot_memobench.evaluation.statistics import DRAWS, Array, Estimate, interval_of, nested_mean
from lerobot_memobench.evaluation.tables import Cell, Name, Numbers, Section, Table, percent_text, with_interval
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import DIFFICULTIES

RATES = ("follows", "wrong", "undecided", "success")
"""A warranted choice: the answer is the evidence's; another answer was given; none was; the goal held at the end."""
RIGHT, RELIABLE = "right", "reliable"
"""Share of the evidence's among the answers given; share of pairs of variants of a scene that were both followed."""
SHOWN = {name: name for name in RATES[:3]} | {RIGHT: "right, of the decided", RELIABLE: "reliable pairs"}
"""Columns of the tables: rate -> title."""
ENOUGH = 35  # effective scenes from which on the interval of a perfect policy begins at 90 %
SENTENCE = (
    "Each scene was run with each variant of its task, so only the past differs. Follows: the answer, by the first "
    "object lifted or joint moved, is the one that the evidence asks for; right, of the decided: among rollouts with "
    "an answer; reliable pairs: pairs of variants of a scene in which both answers are right. Chance: the best rate of "
    "a policy without the past that cannot look before it chooses. Per cent, with the 95 % interval of a bootstrap "
    "over scenes, at least Wilson's of their effective number. p: of a permutation of the answers within scenes. Tasks "
    "whose instruction names the answer have no chance and are in no average."
)


@dataclass(frozen=True)
class Evidence:
    """Rates of one or several tasks: means over scenes; the variants of a scene have equal weights.

    Attributes:
        scenes, variants: how many; of several tasks the sum of scenes, and no number of variants.
        chance: of following without the past; None where the instruction names the answer.
        rates: of `RATES`, `RIGHT` and `RELIABLE`, with intervals; `RIGHT` is missing where no rollout had an answer.
        p: one-sided, of as many right answers when they are permuted within scenes.
        effective: number of scenes of equal weight with the same variance.
    """

    scenes: int
    variants: int | None
    chance: float | None
    rates: Mapping[str, Estimate]
    p: float
    effective: float


class EvidenceRates(NamedTuple):
    """The rates of an evaluation; the average is the mean over memory types, None where no task has a chance."""

    tasks: dict[str, Evidence]
    memory_types: dict[str, Evidence]
    average: Evidence | None
    notes: list[str]


class _TaskScenes(NamedTuple):
    """Rates of `RATES` and `RELIABLE` per scene (S, 5), the scenes that are drawn (D, S), and permuted rates (D,)."""

    variants: int
    chance: float | None
    values: Array
    drawn: Any
    permuted: Array


def evidence_of(records: Sequence[Record]) -> EvidenceRates | None:
    """Return how often choices follow the evidence, None unless scenes of a task were run with several variants."""
    groups = _by_task(records)
    if not groups:
        return None
    rng = np.random.default_rng(0)  # the same log has the same intervals
    tasks: dict[str, _TaskScenes] = {}
    types: dict[str, list[_TaskScenes]] = {}
    left_out, without_rate = 0, list[str]()
    for name, group in groups.items():
        scenes: dict[int, dict[int, Record]] = {}
        for record in group:
            scenes.setdefault(record.get("seed") or 0, {})[record.get("variant") or 0] = record
        whole = [list(scene.values()) for scene in scenes.values() if len(scene) == int(group[0]["variants"])]
        left_out += len(group) - sum(map(len, whole))
        if not whole:
            without_rate.append(name)
            continue
        values = np.array([_rates_of_scene(scene) for scene in whole])
        drawn = rng.integers(len(whole), size=(DRAWS, len(whole)))
        permuted = np.mean([_permuted(scene, rng) for scene in whole], axis=0)
        tasks[name] = _TaskScenes(int(group[0]["variants"]), group[0].get("chance"), values, drawn, permuted)
        if tasks[name].chance is not None:
            types.setdefault(str(group[0]["memory_type"]), []).append(tasks[name])
    average = _rates(list(types.values())) if types else None
    notes = []
    if left_out:
        absent = f"; no rate of {' and '.join(without_rate)}" if without_rate else ""
        notes.append(f"{count_of(left_out, 'rollout')} of scenes that were not run with every variant left out{absent}")
    if average is not None and average.effective < ENOUGH:
        notes.append(
            f"the average has {average.effective:.0f} effective scenes; with fewer than {ENOUGH} the interval of a "
            "perfect policy begins below 90 %: run more episodes, 36 of each task by default"
        )
    return EvidenceRates(
        {name: _rates([[task]]) for name, task in tasks.items()},
        {name: _rates([group]) for name, group in types.items()},
        average,
        notes,
    )


def _by_task(records: Iterable[Record]) -> dict[str, list[Record]]:
    return by_task(record for record in records if "choice" in record and varies(record))


def _rates_of_scene(scene: Sequence[Record]) -> list[float]:
    right = np.array([record["choice"] == record.get("variant") for record in scene])
    answered = np.array([bool(record.get("answered", record["choice"] is not None)) for record in scene])
    success = np.mean([bool(record["success"]) for record in scene])
    pairs = [bool(a and b) for a, b in combinations(right, 2)]
    rates = right.mean(), (answered & ~right).mean(), (~answered).mean(), success, np.mean(pairs) if pairs else np.nan
    return [float(rate) for rate in rates]


def _permuted(scene: Sequence[Record], rng: np.random.Generator) -> Array:
    """Return the share of right answers in a scene, (D,), when answers to one instruction are exchanged."""
    instruction, goal = _alike(str(scene[0]["task"]))
    right = np.zeros(DRAWS)
    groups: dict[Any, list[Record]] = {}
    for record in scene:
        groups.setdefault(instruction.get(record.get("variant") or 0), []).append(record)
    for group in groups.values():
        shown = np.array([goal.get(k := record.get("variant") or 0, k) for record in group])
        # -1, no answer, is no variant.
        chosen = np.array([-1 if (k := record["choice"]) is None else goal.get(k, k) for record in group])
        right += (rng.permuted(np.tile(chosen, (DRAWS, 1)), axis=1) == shown).sum(axis=1)
    return right / len(scene)


@cache
def _alike(name: str) -> tuple[dict[int, str], dict[int, int]]:
    """Return variant -> instruction and variant -> first variant with its goal; empty for unknown tasks."""
    try:
        task = get_task(name).at(DIFFICULTIES[-1])
    except MemobenchError:
        return {}, {}
    variants = [task.variant(k) for k in task.random_variants]
    first: dict[Any, int] = {}
    for variant in variants:
        first.setdefault((variant.language, variant.goal), variant.variant_index)
    instructions = {variant.variant_index: variant.language for variant in variants}
    return instructions, {variant.variant_index: first[variant.language, variant.goal] for variant in variants}


def _rates(groups: Sequence[Sequence[_TaskScenes]]) -> Evidence:
    """Return the mean over groups of the means over their tasks, with intervals over scenes."""
    tasks = [task for group in groups for task in group]
    rates = nested_mean([[task.values.mean(axis=0) for task in group] for group in groups])
    drawn = nested_mean([[task.values[task.drawn].mean(axis=1) for task in group] for group in groups])
    weights = [1 / (len(groups) * len(group) * len(task.values)) for group in groups for task in group]
    scenes = max(1.0, 1 / sum(len(task.values) * weight**2 for task, weight in zip(tasks, weights, strict=True)))
    estimates = {name: _estimate(rates[k], drawn[:, k], scenes) for k, name in enumerate((*RATES, RELIABLE))}
    decided, of_draws = 1 - rates[2], 1 - drawn[:, 2]
    if decided > 0:
        # A draw without any answer has no such rate.
        right = drawn[of_draws > 0, 0] / of_draws[of_draws > 0]
        estimates[RIGHT] = _estimate(rates[0] / decided, right, max(1.0, scenes * decided))
    alone = len(tasks) == 1
    chances = [[task.chance for task in group] for group in groups]
    permuted = nested_mean([[task.permuted for task in group] for group in groups])
    return Evidence(
        # Equal means of other orders of addition may differ in their last bits.
        p=(1 + int((permuted >= rates[0] - 1e-9).sum())) / (1 + len(permuted)),
        effective=scenes,
        scenes=sum(len(task.values) for task in tasks),
        variants=tasks[0].variants if alone else None,
        chance=tasks[0].chance if alone else float(nested_mean(chances)),
        rates=estimates,
    )


def _estimate(rate: float, drawn: Array, scenes: float) -> Estimate:
    # The quotient of two equal rates may exceed 1 by rounding.
    return Estimate(float(rate), *interval_of(drawn, wilson(min(float(rate), 1.0), scenes)))


# --- the report ---


def evidence_section(evidence: EvidenceRates) -> Section:
    """Return the tables of the rates."""
    header = ("scenes", "chance", *SHOWN.values(), "p")
    rows = [_row(name, rates) for name, rates in evidence.memory_types.items()]
    of_tasks = [_row(Name(name), rates) for name, rates in evidence.tasks.items()]
    tables = [Table("evidence_tasks", "", ("task", *header), of_tasks)]
    if evidence.average is not None:
        rows.append(_row("average", evidence.average))
        tables.insert(0, Table("evidence", "", ("memory type", *header), rows, strong={len(rows) - 1}))
    return Section("Evidence", tables, [SENTENCE], evidence.notes)


def _row(name: str, evidence: Evidence) -> tuple[Cell, ...]:
    rates = [evidence.rates.get(name) for name in SHOWN]
    cells = [None if rate is None else Numbers(with_interval(rate.value, rate.low, rate.high)) for rate in rates]
    return (name, evidence.scenes, Numbers(percent_text(evidence.chance)), *cells, Numbers(f"{evidence.p:.2g}"))


def evidence_data(evidence: EvidenceRates, records: Sequence[Record]) -> dict[str, Any]:
    """Return the rates as JSON values, per cent, and how often each variant of a task was chosen."""
    groups = _by_task(records)
    return {
        "average": None if evidence.average is None else _data(evidence.average),
        "tasks": {name: {**_data(rates), "choices": _choices(groups[name])} for name, rates in evidence.tasks.items()},
        "memory_types": {name: _data(rates) for name, rates in evidence.memory_types.items()},
    }


def _choices(group: Sequence[Record]) -> dict[str, dict[str, int]]:
    """Return variant of the scene -> chosen variant, or "none" -> rollouts."""
    choices: dict[str, Counter[str]] = {}
    for record in group:
        chosen = "none" if record["choice"] is None else str(record["choice"])
        choices.setdefault(str(record.get("variant")), Counter())[chosen] += 1
    return {variant: dict(sorted(counts.items())) for variant, counts in sorted(choices.items())}


def _data(evidence: Evidence) -> dict[str, Any]:
    rates: dict[str, Any] = {
        name: {"percent": percent(rate.value), "low": percent(rate.low), "high": percent(rate.high)}
        for name, rate in evidence.rates.items()
    }
    rates.setdefault(RIGHT, None)
    size = {"scenes": evidence.scenes, "effective_scenes": round(evidence.effective, 1), "variants": evidence.variants}
    return {**size, "chance": percent(evidence.chance), "p": evidence.p, **rates}


def evidence_phrase(evidence: EvidenceRates) -> list[str]:
    """Return the average in words, for one line; [] where there is none."""
    if evidence.average is None:
        return []
    follows = percent_text(evidence.average.rates["follows"].value)
    return [f"follows the evidence {follows} %, chance {percent_text(evidence.average.chance)} %"]
