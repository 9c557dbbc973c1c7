"""Classify a failed rollout by its checkpoints (paper, failure taxonomy).

Two classes extend the paper's five, which would misclassify these rollouts: a procedure in another order than the
prompt's, and a horizon below the protocol's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lerobot_memobench.tasks.formula import Formula, Round, Then, When, children
from lerobot_memobench.tasks.task import Task

REFERENCE_DRIFT = "reference_drift"
"""The policy acted on a wrong referent."""
WRONG_ORDER = "wrong_order"
"""The steps of a procedure were done in another order than in the prompt."""
CUT_OFF = "cut_off"
"""A horizon below the protocol's ended the rollout; its memory is not assessed."""

#: Failure classes of the published tasks, in the order of the report.
FAILURES = (
    "storage_failure",
    "stale_memory",
    "compression_collapse",
    REFERENCE_DRIFT,
    "execution_failure",
)
#: Classes in addition to the paper's; reports name those that occur.
REFINED_FAILURES = (WRONG_ORDER, CUT_OFF)

INVALID_ACTION, UNSTABLE_PHYSICS = "invalid_action", "unstable_physics"
FAULTS = (INVALID_ACTION, UNSTABLE_PHYSICS)
"""Classes of aborted rollouts, which do not assess memory."""

_BY_OPERATION = {"S": "storage_failure", "U": "stale_memory", "C": "compression_collapse"}


def classify_failure(
    task: Task,
    first_steps: Sequence[int | None],
    success: bool,
    drift: bool = False,
    lost: bool = False,
    cut_off: bool = False,
) -> str | None:
    """Return the failure class of an execution of ``task``, None for a success.

    Args:
        first_steps: (K,) first execution step at which each checkpoint's predicate held; None for never.
        success: whether the goal held at the end.
        drift: whether a wrong answer was given (object and procedural tasks).
        lost: whether the goal became unreachable (strict tasks).
        cut_off: whether a horizon below the protocol's ended the episode.
    """
    if lost and task.spoilt_as is not None:
        return task.spoilt_as
    found = classify(task.operations, first_steps, success, drift)
    if found in (None, REFERENCE_DRIFT):
        return found
    if task.memory_type == "procedural" and asks_order(task.goal) and _out_of_order(first_steps):
        return WRONG_ORDER
    return CUT_OFF if cut_off and None in first_steps else found


def classify(
    operations: Sequence[str], first_steps: Sequence[int | None], success: bool, drift: bool = False
) -> str | None:
    """Return the paper's class from the operation labels ("S", "U" or "C") of the checkpoints.

    The first checkpoint that was never satisfied determines the class, unless a drift explains it. With all checkpoints
    satisfied, the execution failed, not the memory.
    """
    if success:
        return None
    for operation, first_step in zip(operations, first_steps, strict=True):
        if first_step is None:
            return REFERENCE_DRIFT if drift else _BY_OPERATION[operation]
    return "execution_failure"


def asks_order(goal: Formula) -> bool:
    """Return whether a goal requires an order of its parts."""
    return any(isinstance(part, Then | When | Round) for part in _parts(goal))


def _parts(formula: Formula) -> Iterator[Formula]:
    yield formula
    for child in children(formula):
        yield from _parts(child)


def _out_of_order(first_steps: Sequence[int | None]) -> bool:
    """Return whether a checkpoint was satisfied before, or without, an earlier one."""
    earlier_missing, latest = False, 0
    for step in first_steps:
        if step is None:
            earlier_missing = True
            continue
        if earlier_missing or step < latest:
            return True
        latest = step
    return False
