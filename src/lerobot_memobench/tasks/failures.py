"""Classify a failed rollout by its checkpoints (paper, failure taxonomy).

Two classes extend the paper's five, which would misclassify these rollouts: a procedure in another order than the
prompt's, and a horizon below the protocol's.
"""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.tasks.formula import Formula, Never, Round, Then, When, atoms, walk
from lerobot_memobench.tasks.task import HAND, MISCOUNT, STRICT, Task

REFERENCE_DRIFT = "reference_drift"
"""The policy acted on a wrong referent."""
WRONG_ORDER = "wrong_order"
"""The steps of a procedure, or the events of an ordering task, were done in another order than asked for."""
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
    lost: Formula | None = None,
    cut_off: bool = False,
    ordered: bool = False,
) -> str | None:
    """Return the failure class of an execution of ``task``, None for a success.

    Args:
        first_steps: (K,) first execution step at which each checkpoint's predicate held; None for never.
        drift: whether a wrong answer was given (object and procedural tasks).
        lost, ordered: `Progress.broken` and `Progress.ordered` of strict tasks.
        cut_off: whether a horizon below the protocol's ended the episode.
    """
    if lost and (spoilt := _spoilt(task, first_steps, lost)) is not None:
        return spoilt
    failure = classify(task.operations, first_steps, success, drift)
    if failure in (None, REFERENCE_DRIFT):
        return failure
    if task.memory_type == "procedural" and asks_order(task.goal) and _out_of_order(first_steps):
        return WRONG_ORDER
    if cut_off and (not first_steps or None in first_steps):
        return CUT_OFF
    return HAND if None in first_steps and _memory_served(task, first_steps, ordered) else failure


def _spoilt(task: Task, first_steps: Sequence[int | None], lost: Formula) -> str | None:
    """Return the class of a strict rollout by the part of the goal that it broke; None: by its checkpoints."""
    if isinstance(lost, Never) and any(atom.predicate == "handhome" for atom in atoms(lost)):
        return HAND  # came home and left something ajar
    if task.spoilt_as is not None or task.memory_type != "temporal":
        return task.spoilt_as
    if not isinstance(lost, When):
        return MISCOUNT
    # The earlier event was complete, and only the hand's return was missing.
    before = [part for part in walk(lost) if isinstance(part, Round)]
    complete = [
        step is not None and any(isinstance(part, Round) and part.children == event.children[:-1] for event in before)
        for checkpoint, step in zip(task.checkpoints, first_steps, strict=True)
        for part in walk(checkpoint.goal)
    ]
    return HAND if any(complete) else WRONG_ORDER


def _memory_served(task: Task, first_steps: Sequence[int | None], ordered: bool) -> bool:
    """Return whether a strict rollout did all that it had to remember, so that what is missing is the hand's.

    Before the first event of an instruction there is nothing to remember; a hidden thing is where its drawer is opened.
    """
    if task.suite != STRICT or task.memory_type not in ("temporal", "spatial"):
        return False
    return ordered or (first_steps[0] is None) == (task.memory_type == "temporal")


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
    """Return whether a goal asks for an order of its parts."""
    return any(isinstance(part, Then | When | Round) for part in walk(goal))


def _out_of_order(first_steps: Sequence[int | None]) -> bool:
    """Return whether a checkpoint was satisfied before, or without, an earlier one."""
    reached = [step for step in first_steps if step is not None]
    return reached != sorted(reached) or None in first_steps[: len(reached)]
