"""What the paper's controls share: evaluations of the same episodes side by side, and annotation granularity.

Rollouts are paired by episode within each replan interval.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import POLICY, differences, read_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import (
    METRICS,
    PROCESS_METRICS,
    Rate,
    Record,
    Summary,
    operations,
    percent,
    policy_inputs,
    summarise,
)
from lerobot_memobench.evaluation.records import asked_for, read_protocol
from lerobot_memobench.evaluation.report_tables import inputs_phrase
from lerobot_memobench.evaluation.tables import Cell, Name, Report, Section, Table
from lerobot_memobench.io import count_of
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import LEVELS, OPERATIONS

Pairs = dict[int | None, tuple[list[Record], list[Record]]]
"""Replan interval -> the rollouts of the first and of the second set, episode by episode."""


def pairs_by_replan(
    first: Sequence[Path], second: Sequence[Path], ignore: Sequence[str] = ()
) -> tuple[Pairs, list[str]]:
    """Return the paired rollouts of two sets of evaluations, and what a reader must know.

    Raises:
        MemobenchError: their protocols differ in more than what is ignored, or they have no interval in common.
    """
    check_alike(first, second, ignore)
    notes: list[str] = []
    inputs: list[str] = []
    a, b = (
        by_replan([record for folder in folders for record in _rollouts(folder, notes, inputs)])
        for folders in (first, second)
    )
    common = [replan for replan in a if replan in b]
    if not common:
        raise MemobenchError(
            f"the evaluations have no replan interval in common ({', '.join(map(str, a))} and "
            f"{', '.join(map(str, b))}); evaluate both with the same replan="
        )
    notes += [
        f"replan interval {replan} is in one of them only and is left out"
        for replan in [*a, *b]
        if replan not in common
    ]
    found: Pairs = {}
    for replan in common:
        left, right, partnerless = paired(a[replan], b[replan])
        found[replan] = (left, right)
        if partnerless:
            alone = count_of(partnerless, "rollout")
            notes.append(f"replan interval {replan}: {alone} without a partner left out")
    return found, notes + inputs


def check_alike(first: Sequence[Path], second: Sequence[Path], ignore: Sequence[str] = ()) -> None:
    """Refuse evaluations that differ in more than the policy, the replan interval and what is ignored.

    Raises:
        MemobenchError: naming the first two of them.
    """
    for folders in (first, second):
        check_one_policy(folders)
    reference = read_protocol(first[0])
    for folder in [*first[1:], *second]:
        found = differences(reference, read_protocol(folder), ignore=("replan_steps", *ignore))
        if found:
            raise MemobenchError(
                f"{first[0]} and {folder} were evaluated under different protocols ({'; '.join(found)}); evaluate both "
                "under the same one"
            )


def check_place(folders: Sequence[Path], setting: str, value: Any, *, of_policy: bool = False) -> None:
    """Refuse evaluations that tell another value of a setting than their place among a control's arguments says.

    Args:
        of_policy: the setting is its policy's, by the card.

    Raises:
        MemobenchError: naming the first of them.
    """
    for folder in folders:
        protocol = read_protocol(folder)
        told = protocol[POLICY].get("settings", {}) if of_policy else protocol
        if told.get(setting, value) != value:
            raise MemobenchError(
                f"{folder} is of {setting}={told[setting]}, and stands where {setting}={value} is expected; name the "
                "folders in the order that `memobench controls --help` says"
            )


def check_one_policy(folders: Sequence[Path]) -> None:
    """Refuse evaluations of two policies where those of one, at several replan intervals, were expected.

    Raises:
        MemobenchError: naming the first two.
    """
    told = {folder: read_protocol(folder)[POLICY] for folder in folders}
    for key in ("type", "sha256"):
        known = {folder: policy[key] for folder, policy in told.items() if policy.get(key)}
        if len(set(known.values())) > 1:
            (a, mine), (b, other) = next(pair for pair in combinations(known.items(), 2) if pair[0][1] != pair[1][1])
            raise MemobenchError(
                f"{a} and {b} are of two policies ({key} {str(mine)[:12]} and {str(other)[:12]}); expected one policy "
                "at several replan intervals, so leave one of them out"
            )


def _rollouts(folder: Path, notes: list[str], inputs: list[str]) -> list[Record]:
    """Return the rollouts of an evaluation that were asked for; its policy's inputs are told in ``inputs``."""
    lines = asked_for(folder, read_log(folder, notes), notes)
    found: list[Record] = [record for record in lines if "not_run" not in record]
    inputs.append(f"{folder}: {inputs_phrase(policy_inputs(found))}")
    return found


def by_replan(records: Sequence[Record]) -> dict[int | None, list[Record]]:
    """Group rollouts by replan interval, ascending; unknown intervals last."""
    groups: dict[int | None, list[Record]] = {}
    for record in records:
        groups.setdefault(record.get("replan_steps"), []).append(record)
    return dict(sorted(groups.items(), key=lambda item: (item[0] is None, item[0] or 0)))


def paired(a: Sequence[Record], b: Sequence[Record]) -> tuple[list[Record], list[Record], int]:
    """Return the rollouts of episodes that both have, in one order, and how many of either had no partner.

    Raises:
        MemobenchError: no episode is in both, one is in either of them twice, or a task differs in its checkpoints.
    """
    tables = []
    for records in (a, b):
        table: dict[tuple[Any, ...], Record] = {}
        for record in records:
            key = (record["task"], record.get("referent", "fixed"), record["episode"], record.get("seed"))
            if key in table:
                raise MemobenchError(
                    f"episode {record['episode']} of {record['task']!r} was given twice under one replan interval; "
                    "name each evaluation once"
                )
            table[key] = record
        tables.append(table)
    common = [key for key in tables[0] if key in tables[1]]
    if not common:
        raise MemobenchError(
            f"the evaluations have no episode in common ({len(a)} and {count_of(len(b), 'rollout')}); compare "
            "evaluations of the same tasks, seeds and referent"
        )
    for key in common:
        first, second = (operations(table[key]) for table in tables)
        if first != second:
            raise MemobenchError(
                f"{key[0]!r} has other checkpoints in one evaluation ({first}) than in the other ({second}); compare "
                "evaluations of one version of the task"
            )
    alone = len(tables[0]) + len(tables[1]) - 2 * len(common)
    return [tables[0][key] for key in common], [tables[1][key] for key in common], alone


def rollouts_by_level(*folders: Path) -> tuple[dict[str, list[Record]], list[str]]:
    """Return the rollouts of an evaluation per language level of the subgoals taught, and what a reader must know.

    Args:
        folders: one for each of `LEVELS`, in their order.

    Raises:
        MemobenchError: they were evaluated under different protocols or at different replan intervals.
    """
    for level, folder in zip(LEVELS, folders, strict=True):
        check_place([folder], "subgoal_level", level, of_policy=True)
        check_alike(folders[:1], [folder])
    notes: list[str] = []
    inputs: list[str] = []
    levels: dict[str, list[Record]] = {
        level: _rollouts(folder, notes, inputs) for level, folder in zip(LEVELS, folders, strict=True)
    }
    intervals = {level: list(by_replan(records)) for level, records in levels.items()}
    if len({tuple(found) for found in intervals.values()}) > 1:
        told = ", ".join(f"{level} {'/'.join(map(str, found))}" for level, found in intervals.items())
        raise MemobenchError(f"the levels were evaluated at different replan intervals ({told}); use the same replan=")
    if len(intervals[LEVELS[0]]) > 1:
        notes.append("the evaluations mix replan intervals; the figures are over all of them")
    return levels, notes + inputs


# --- tables ---

PAPER = "paper"
PAPER_TASK = "paper, stove task of three checkpoints"


def replan_title(replan: int | None) -> str:
    """Return the title of a table of rollouts of one replan interval."""
    return f"replan interval {'unknown' if replan is None else replan}"


def prefix_header(second: str, width: int) -> tuple[str, ...]:
    """Return the header; ``second`` names the column after the task, ``width`` is the number of checkpoints."""
    return ("task", second, *(f"c{k + 1}" for k in range(width)), "success")


def prefix_row(task: str, second: str, cells: Sequence[Cell], width: int) -> tuple[Cell, ...]:
    """Return a row; a task with fewer checkpoints than the widest has empty cells, and success comes last."""
    *checkpoints, success = cells
    return (task, second, *checkpoints, *([None] * (width - len(checkpoints))), success)


# --- annotation granularity: metrics by the language level that a policy was taught with ---

PAPER_GRANULARITY = {"coarse": (4, 50), "intermediate": (3, 50), "fine": (3, 50)}
"""Successful rollouts of that task by subgoal level (paper, annotation granularity; said in its text only)."""

GRANULARITY_SENTENCE = (
    "Per cent with Wilson's 95 % interval over rollouts. MSR, MUR and MCR are averages over memory types, under "
    "the evaluated (intermediate) labels and under those of the level itself."
)


def _with_labels_of(level: str, records: Sequence[Record]) -> list[Record]:
    """Return rollouts of the catalogue's tasks with the operation labels of a level, others as they are."""
    index = LEVELS.index(level)
    there = {record["task"] for record in records} & set(task_names(suite=None))
    return relabelled(
        records, {name: [each.operations_by_level[index] for each in get_task(name).checkpoints] for name in there}
    )


def relabelled(records: Sequence[Record], labels: Mapping[str, Sequence[str]]) -> list[Record]:
    """Return rollouts with the operation labels of another language level; tasks without labels keep theirs.

    Args:
        labels: task → operation per checkpoint ("S", "U" or "C").
    """
    result: list[Record] = []
    for record in records:
        wanted = labels.get(record["task"])
        if wanted is None:
            result.append(record)
            continue
        if len(wanted) != len(record["checkpoints"]) or not set(wanted) <= set(OPERATIONS):
            raise MemobenchError(
                f"a rollout of {record['task']!r} has {len(record['checkpoints'])} checkpoints, its labels are "
                f"{', '.join(wanted)}; the log was written by another version of the task"
            )
        checkpoints = [
            {**checkpoint, "operation": operation}
            for checkpoint, operation in zip(record["checkpoints"], wanted, strict=True)
        ]
        result.append({**record, "checkpoints": checkpoints})
    return result


def granularity_report(levels: Mapping[str, Sequence[Record]], paper: bool = False) -> Report:
    """Return metrics by language level and prefix completion by level.

    Args:
        levels: level -> rollouts of the policy that was taught at it. paper: add the published successes.
    """
    summaries = {level: summarise(records) for level, records in levels.items()}
    own = {level: summarise(_with_labels_of(level, records)) for level, records in levels.items()}
    tables = (_rates(summaries, own), _prefixes(summaries, paper))
    data = {
        level: {
            "n": summary.rollouts,
            "average": {metric: percent(rate.value) for metric, rate in summary.average.items()},
            "own_labels": {metric: percent(rate.value) for metric, rate in own[level].average.items()},
            "tasks": {
                task: {
                    "SR": percent(row["SR"].value),
                    "prefix": [percent(rate.value) for rate in summary.prefix[task]],
                }
                for task, row in summary.tasks.items()
            },
        }
        for level, summary in summaries.items()
    }
    return Report("Annotation granularity", (Section("", tables, sentences=(GRANULARITY_SENTENCE,)),), data)


def _rates(summaries: Mapping[str, Summary], own: Mapping[str, Summary]) -> Table:
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            level,
            *(summary.average[metric] for metric in METRICS),
            *(own[level].average[metric] for metric in PROCESS_METRICS),
        )
        for level, summary in summaries.items()
    )
    header = ("level", *METRICS, *(f"{metric}, own labels" for metric in PROCESS_METRICS))
    return Table("granularity", "metrics by level", header, rows)


def _prefixes(summaries: Mapping[str, Summary], paper: bool) -> Table:
    width = max(len(rates) for summary in summaries.values() for rates in summary.prefix.values())
    names = dict.fromkeys(task for summary in summaries.values() for task in summary.tasks)
    rows: list[tuple[Cell, ...]] = [
        prefix_row(Name(task), level, [*summary.prefix[task], summary.tasks[task]["SR"]], width)
        for task in names
        for level, summary in summaries.items()
        if task in summary.tasks
    ]
    if paper:
        for level, (good, n) in PAPER_GRANULARITY.items():
            rows.append(prefix_row(PAPER_TASK, level, [*([None] * width), Rate(good / n, n)], width))
    return Table("granularity_prefix", "prefix completion by level", prefix_header("level", width), tuple(rows))
