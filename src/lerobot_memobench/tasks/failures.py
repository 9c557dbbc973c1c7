"""Why a rollout failed: one class per rollout, from what its checkpoints show (paper, failure taxonomy)."""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.tasks.task import Task

REFERENCE_DRIFT = "reference_drift"
"""The class of a failure at a wrong referent."""

#: Failure classes of the published tasks, in the order of the report.
FAILURES = (
    "storage_failure",
    "stale_memory",
    "compression_collapse",
    REFERENCE_DRIFT,
    "execution_failure",
)

INVALID_ACTION, UNSTABLE_PHYSICS = "invalid_action", "unstable_physics"
FAULTS = (INVALID_ACTION, UNSTABLE_PHYSICS)
"""What cuts a rollout off that tells nothing of a memory: an action that is none, and physics that broke down."""

_BY_OPERATION = {"S": "storage_failure", "U": "stale_memory", "C": "compression_collapse"}


def classify_failure(
    task: Task, first_steps: Sequence[int | None], success: bool, drift: bool = False, lost: bool = False
) -> str | None:
    """Return the failure class of an execution of ``task``, or None when it succeeded.

    Args:
        first_steps: (K,) per checkpoint the first execution step at which its predicate held, None for never.
        success: the goal held at termination.
        drift: a wrong sibling of the referent or of the target satisfied the relation (object tasks).
        lost: the goal could no longer be reached (strict tasks).
    """
    if lost and task.spoilt_as is not None:
        return task.spoilt_as
    return classify(task.operations, first_steps, success, drift)


def classify(
    operations: Sequence[str], first_steps: Sequence[int | None], success: bool, drift: bool = False
) -> str | None:
    """Like ``classify_failure``, from the checkpoints' operation labels ("S", "U" or "C") alone.

    The first checkpoint that was never satisfied names the class. A drift explains why it is missing, so it
    goes before; once every checkpoint was satisfied the memory did its work and the hand did not.
    """
    if success:
        return None
    for operation, first_step in zip(operations, first_steps, strict=True):
        if first_step is None:
            return REFERENCE_DRIFT if drift else _BY_OPERATION[operation]
    return "execution_failure"
