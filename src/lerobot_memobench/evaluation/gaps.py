"""Group the checkpoints of an evaluation by their gap: control steps from the cue to its use (`tasks.gap`)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

from lerobot_memobench.evaluation.metrics import Record
from lerobot_memobench.tasks.catalogue import get_task, suite_of
from lerobot_memobench.tasks.gap import gaps

EDGES = (0, 2, 64, 128, 256, 512, 1024, 2048, 4096, 8192)
"""Bounds of the groups, control steps; the first group needs no memory over time."""
GROUPS = [f"{low}–{high - 1}" for low, high in pairwise(EDGES)]


def success_by_gap(records: Sequence[Record]) -> dict[str, tuple[int, int]]:
    """Return for each group of gaps with checkpoints how many were reached, and how many there are.

    A checkpoint counts if all earlier ones were reached in order: only then its information had to be remembered.
    """
    found: dict[str, tuple[int, int]] = {}
    samples = [sample for record in records for sample in _samples(record)]
    for group, (low, high) in zip(GROUPS, pairwise(EDGES), strict=True):
        reached = [done for gap, done in samples if low <= gap < high]
        if reached:
            found[group] = sum(reached), len(reached)
    return found


def _samples(record: Record) -> Iterator[tuple[int, bool]]:
    """Yield gap and success of the checkpoints that an episode came to; none for tasks without measured gaps."""
    if suite_of(record["task"]) is None:
        return
    task = get_task(record["task"])
    for gap, checkpoint in zip(gaps(task), record["checkpoints"], strict=False):
        steps = 0 if gap is None else gap.median
        reached = checkpoint.get("ordered_step") is not None
        yield steps, reached
        if not reached:
            return
