"""Pauses and slower actions, each against the policy as it is, episode by episode.

What a policy has done and seen is the same, when is not: a policy that tells by a clock what is next loses, one that
remembers what happened does not. The result is kept in the folder of the paced evaluation (``pacing.json``), whose
reports show it from then on.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NotRequired, TypedDict, cast

from lerobot_memobench.envs.episode_log import UNTOLD
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.controls import check_one_policy, pairs_by_replan, replan_title
from lerobot_memobench.evaluation.memory_controls import (
    AVERAGE,
    Contrast,
    contrasts_by_type,
    contrasts_of,
    grouped,
    paired_outcomes,
)
from lerobot_memobench.evaluation.metrics import METRICS, Record, percent
from lerobot_memobench.evaluation.records import read_protocol
from lerobot_memobench.evaluation.statistics import DRAWS
from lerobot_memobench.evaluation.tables import NOT_APPLICABLE, Cell, Name, Numbers, Section, Table
from lerobot_memobench.io import Count, Number, read_json, write_file
from lerobot_memobench.tasks.catalogue import get_task, task_names

PACING_FILE = "pacing.json"
TITLES = {"pause_steps": "Pauses", "speed": "Slower actions"}
"""Setting -> title of its control."""
SENTENCE = (
    "Per cent; change is the paced evaluation minus the plain one over the same episodes, with the 95 % interval of a "
    "bootstrap over pairs, at least Newcombe's. – where an operation does not occur. A memory type is the mean of its "
    "tasks, the average the mean of memory types."
)


class Change(TypedDict):
    """One metric under both evaluations, per cent."""

    plain: Number
    paced: Number
    change: Number
    low: Number
    high: Number


Changes = dict[str, Change | None]
"""Metric -> change; None where it does not apply."""


class Paced(TypedDict):
    """What a pace changes, at one replan interval.

    Attributes:
        setting: pause_steps or speed. value: in the paced evaluation; in the plain one it is the default.
        replan_steps: actions per prediction, where known. pairs: of rollouts.
        paused_steps: control steps of pauses per paced rollout, on average.
    """

    setting: Literal["pause_steps", "speed"]
    value: Number
    replan_steps: Count | None
    pairs: Count
    paused_steps: NotRequired[Number]
    average: Changes
    memory_types: dict[str, Changes]
    families: dict[str, Changes]
    tasks: dict[str, Changes]


def paced_changes(setting: str, plain: Path, paced: Path, draws: int = DRAWS) -> tuple[list[Paced], list[str]]:
    """Return what a pace changes, for each replan interval, and what a reader must know.

    Args:
        setting: in which the evaluations differ: ``pause_steps`` or ``speed``. plain, paced: their folders.

    Raises:
        MemobenchError: one is not what it was named as, they are of two policies, or differ in more.
    """
    value, paces = (read_protocol(folder).get(setting, UNTOLD[setting]) for folder in (plain, paced))
    if value != UNTOLD[setting] or paces == UNTOLD[setting]:
        raise MemobenchError(
            f"{plain} was evaluated with {setting}={value} and {paced} with {setting}={paces}; expected first the "
            f"evaluation without (the default, {UNTOLD[setting]}), then the one with"
        )
    check_one_policy([plain, paced])
    pairs, notes = pairs_by_replan([plain], [paced], ignore=(setting,))
    return [_paced(setting, paces, replan, a, b, draws) for replan, (a, b) in pairs.items()], notes


def _paced(
    setting: str, value: float, replan: int | None, plain: Sequence[Record], paced: Sequence[Record], draws: int
) -> Paced:
    outcomes = paired_outcomes(plain, paced, draws)
    families = {task: get_task(task).family for task in outcomes if task in task_names(suite=None)}
    kinds = {name: _changes(contrasts) for name, contrasts in contrasts_by_type(outcomes, plain).items()}
    found: dict[str, Any] = {
        "setting": setting,
        "value": value,
        "replan_steps": replan,
        "pairs": len(plain),
        AVERAGE: kinds.pop(AVERAGE),
        "memory_types": kinds,
        "families": {name: _changes(contrasts_of([tasks])) for name, tasks in grouped(outcomes, families).items()},
        "tasks": {name: _changes(contrasts_of([[metrics]])) for name, metrics in outcomes.items()},
    }
    rests = [record["paused_steps"] for record in paced if "paused_steps" in record]
    if rests:
        found["paused_steps"] = round(sum(rests) / len(rests), 1)
    return cast("Paced", found)


def _changes(contrasts: Mapping[str, Contrast]) -> Changes:
    return {metric: _change(contrast) for metric, contrast in contrasts.items()}


def _change(found: Contrast) -> Change | None:
    if found.standard is None:
        return None
    values = (found.standard, found.other, found.difference.value, found.difference.low, found.difference.high)
    return cast("Change", dict(zip(Change.__annotations__, map(percent, values), strict=True)))


# --- the report ---


def pacing_section(found: Sequence[Paced]) -> Section:
    """Return the tables of what paces change, with a title."""
    return Section(TITLES[found[0]["setting"]], tuple(table for each in found for table in _tables(each)), (SENTENCE,))


def pace_phrase(found: Paced) -> str:
    """Return the change of the average success in words, for one line."""
    return f"{_pace(found)}: SR {_words(found['average'].get('SR'))}"


def _pace(found: Paced) -> str:
    return f"{found['setting']}={found['value']:g}"


def _tables(found: Paced) -> list[Table]:
    title = f"{_pace(found)}, {replan_title(found['replan_steps'])}"
    rests = "" if "paused_steps" not in found else f"; {found['paused_steps']} steps of pauses in each, on average"
    note = f"{found['pairs']} pairs of rollouts{rests}."
    header = ("SR plain", "SR paced", *(f"{metric} change" for metric in METRICS))
    kinds = [*found["memory_types"].items(), *found["families"].items(), (AVERAGE, found["average"])]
    first = len(found["memory_types"])
    key = f"pacing_{found['replan_steps']}"
    return [
        Table(
            key,
            title,
            ("memory type, family", *header),
            tuple((name, *_cells(changes)) for name, changes in kinds),
            note=note,
            strong=frozenset({len(kinds) - 1}),
            rules=frozenset({first, len(kinds) - 1}),
        ),
        Table(
            f"{key}_tasks",
            f"{title}, by task",
            ("task", *header),
            tuple((Name(name), *_cells(changes)) for name, changes in found["tasks"].items()),
        ),
    ]


def _cells(changes: Changes) -> list[Cell]:
    success = changes.get("SR")
    sides = (NOT_APPLICABLE,) * 2 if success is None else (f"{success['plain']:.1f}", f"{success['paced']:.1f}")
    return [*map(Numbers, sides), *(Numbers(_words(changes.get(metric))) for metric in METRICS)]


def _words(found: Change | None) -> str:
    if found is None:
        return NOT_APPLICABLE
    return f"{found['change']:+.1f} [{found['low']:+.1f}, {found['high']:+.1f}]"


# --- kept beside the paced evaluation ---


def keep_changes(folder: Path, found: Sequence[Paced]) -> None:
    """Write what a pace changes beside the log of the paced evaluation, for its reports."""
    write_file(folder / PACING_FILE, json.dumps(found, indent=1) + "\n")


def kept_changes(folder: Path) -> list[Paced]:
    """Return what was written beside the log of a paced evaluation, [] where nothing was.

    Raises:
        MemobenchError: the file is none of this package's.
    """
    try:
        found: list[Paced] = read_json(
            folder / PACING_FILE, list[Paced], "remove the file; `memobench controls` writes it anew"
        )
    except FileNotFoundError:
        return []
    return found
