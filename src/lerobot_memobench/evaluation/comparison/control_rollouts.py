"""Two sets of evaluations, made comparable: rollouts of the same episodes at the same replan interval, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison.granularity import relabelled
from lerobot_memobench.evaluation.comparison.pairing import by_replan, paired
from lerobot_memobench.evaluation.metrics.rollouts import Record
from lerobot_memobench.evaluation.records.protocol import differences, read_protocol
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import LEVELS

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
    a, b = (
        by_replan([record for folder in folders for record in read_episodes(folder, notes)])
        for folders in (first, second)
    )
    common = [replan for replan in a if replan in b]
    if not common:
        raise MemobenchError(
            f"the evaluations have no replan interval in common ({', '.join(map(str, a))} and "
            f"{', '.join(map(str, b))}); evaluate both with the same replan="
        )
    alone = [replan for replan in [*a, *b] if replan not in common]
    notes += [f"replan interval {replan} is in one of them only and is left out" for replan in alone]
    found: Pairs = {}
    for replan in common:
        left, right, partnerless = paired(a[replan], b[replan])
        found[replan] = (left, right)
        if partnerless:
            notes.append(f"replan interval {replan}: {partnerless} rollouts have no partner and are left out")
    return found, notes


def check_alike(first: Sequence[Path], second: Sequence[Path], ignore: Sequence[str] = ()) -> None:
    """Refuse evaluations that differ in more than the policy, the replan interval and what is ignored.

    Raises:
        MemobenchError: naming the first two of them.
    """
    reference = read_protocol(first[0])
    for folder in [*first[1:], *second]:
        found = differences(reference, read_protocol(folder), ignore=("replan_steps", *ignore))
        if found:
            raise MemobenchError(
                f"{first[0]} and {folder} were evaluated under different protocols ({'; '.join(found)}); evaluate both "
                "under the same one"
            )


def rollouts_by_level(*folders: Path) -> tuple[dict[str, list[Record]], list[str]]:
    """Return the rollouts of an evaluation per language level of the subgoals taught, and what a reader must know.

    Args:
        folders: one for each of `LEVELS`, in their order.

    Raises:
        MemobenchError: they were evaluated under different protocols or at different replan intervals.
    """
    for folder in folders[1:]:
        check_alike(folders[:1], [folder])
    notes: list[str] = []
    levels: dict[str, list[Record]] = {
        level: [*read_episodes(folder, notes)] for level, folder in zip(LEVELS, folders, strict=True)
    }
    intervals = {level: list(by_replan(records)) for level, records in levels.items()}
    if len({tuple(found) for found in intervals.values()}) > 1:
        told = ", ".join(f"{level} {'/'.join(map(str, found))}" for level, found in intervals.items())
        raise MemobenchError(f"the levels were evaluated at different replan intervals ({told}); use the same replan=")
    if len(intervals[LEVELS[0]]) > 1:
        notes.append("the evaluations mix replan intervals; the figures are over all of them")
    return levels, notes


def with_labels_of_level(levels: Mapping[str, Sequence[Record]]) -> dict[str, list[Record]]:
    """Return the rollouts of each level with that level's own operation labels, for the catalogue's tasks."""
    own = {}
    for level, records in levels.items():
        index = LEVELS.index(level)
        labels = {
            name: [checkpoint.operations_by_level[index] for checkpoint in get_task(name).checkpoints]
            for name in {record["task"] for record in records} & set(task_names(suite=None))
        }
        own[level] = relabelled(records, labels)
    return own
