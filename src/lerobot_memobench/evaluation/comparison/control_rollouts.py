"""Two sets of evaluations, made comparable: rollouts of the same episodes at the same replan interval, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison.granularity import relabelled
from lerobot_memobench.evaluation.comparison.pairing import by_replan, paired
from lerobot_memobench.evaluation.documents.sentences import inputs_phrase
from lerobot_memobench.evaluation.metrics.rollouts import Record, policy_inputs
from lerobot_memobench.evaluation.records.protocol import POLICY, differences, read_protocol
from lerobot_memobench.evaluation.records.runs import asked_for
from lerobot_memobench.io import count_of
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
    seen: list[str] = []
    a, b = (
        by_replan([record for folder in folders for record in _rollouts(folder, notes, seen)])
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
    return found, notes + seen


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


def _rollouts(folder: Path, notes: list[str], seen: list[str]) -> list[Record]:
    """Return the rollouts of an evaluation that were asked for; its policy's inputs are told in ``seen``."""
    found: list[Record] = [*asked_for(folder, read_episodes(folder, notes), notes)]
    seen.append(f"{folder}: {inputs_phrase(policy_inputs(found))}")
    return found


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
    seen: list[str] = []
    levels: dict[str, list[Record]] = {
        level: _rollouts(folder, notes, seen) for level, folder in zip(LEVELS, folders, strict=True)
    }
    intervals = {level: list(by_replan(records)) for level, records in levels.items()}
    if len({tuple(found) for found in intervals.values()}) > 1:
        told = ", ".join(f"{level} {'/'.join(map(str, found))}" for level, found in intervals.items())
        raise MemobenchError(f"the levels were evaluated at different replan intervals ({told}); use the same replan=")
    if len(intervals[LEVELS[0]]) > 1:
        notes.append("the evaluations mix replan intervals; the figures are over all of them")
    return levels, notes + seen


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
