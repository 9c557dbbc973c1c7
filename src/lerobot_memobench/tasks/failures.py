"""Why a rollout failed: one class per rollout, from what its checkpoints show (paper, failure taxonomy).

The paper's five classes are kept, and refined by two where they would name a memory's failure wrongly or
not at all: the steps of a procedure in another order than its prompt's, and a horizon that is shorter than the
protocol's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lerobot_memobench.tasks.formula import Formula, Round, Then, When, children
from lerobot_memobench.tasks.task import Task

REFERENCE_DRIFT = "reference_drift"
"""The class of a failure at a wrong referent."""
WRONG_ORDER = "wrong_order"
"""The class of a procedure whose steps were done in another order than the prompt showed."""
CUT_OFF = "cut_off"
"""The class of a rollout that a horizon below the protocol's ended: it is unknown what it would have remembered."""

#: Failure classes of the published tasks, in the order of the report.
FAILURES = (
    "storage_failure",
    "stale_memory",
    "compression_collapse",
    REFERENCE_DRIFT,
    "execution_failure",
)
#: Classes in addition to the paper's; a report names them where they occur.
REFINED_FAILURES = (WRONG_ORDER, CUT_OFF)

INVALID_ACTION, UNSTABLE_PHYSICS = "invalid_action", "unstable_physics"
FAULTS = (INVALID_ACTION, UNSTABLE_PHYSICS)
"""Classes of rollouts that were broken off, which show nothing of memory: invalid actions, unstable physics."""

_BY_OPERATION = {"S": "storage_failure", "U": "stale_memory", "C": "compression_collapse"}


def classify_failure(
    task: Task,
    first_steps: Sequence[int | None],
    success: bool,
    drift: bool = False,
    lost: bool = False,
    cut_off: bool = False,
) -> str | None:
    """Return the failure class of an execution of ``task``, or None when it succeeded.

    Args:
        first_steps: (K,) per checkpoint the first execution step at which its predicate held, None for never.
        success: the goal held at termination.
        drift: another answer than the prompt's satisfied the relation (object and procedural tasks).
        lost: the goal could no longer be reached (strict tasks).
        cut_off: a horizon below the protocol's ended it.
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
    """Return the paper's class, from the checkpoints' operation labels ("S", "U" or "C") alone.

    The first checkpoint that was never satisfied names the class. A drift explains why it is missing, so it
    goes before; once every checkpoint was satisfied the memory did its work and the hand did not.
    """
    if success:
        return None
    for operation, first_step in zip(operations, first_steps, strict=True):
        if first_step is None:
            return REFERENCE_DRIFT if drift else _BY_OPERATION[operation]
    return "execution_failure"


def asks_order(goal: Formula) -> bool:
    """Return whether a goal holds only after its parts have come true in an order."""
    return any(isinstance(part, Then | When | Round) for part in _parts(goal))


def _parts(formula: Formula) -> Iterator[Formula]:
    yield formula
    for child in children(formula):
        yield from _parts(child)


def _out_of_order(first_steps: Sequence[int | None]) -> bool:
    """Whether a checkpoint was satisfied before one that comes before it, or without it."""
    earlier_missing, latest = False, 0
    for step in first_steps:
        if step is None:
            earlier_missing = True
            continue
        if earlier_missing or step < latest:
            return True
        latest = step
    return False
