"""The failure taxonomy."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.failures import failure_counts, failure_of
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.failures import FAILURES, classify, classify_failure


@pytest.mark.parametrize(
    ("operations", "first_steps", "success", "drift", "expected"),
    [
        ("SUC", [1, 2, 3], True, False, None),
        ("SUC", [None, None, None], True, True, None),  # the goal holds, whatever was seen on the way
        ("SUC", [None, 2, 3], False, False, "storage_failure"),
        ("SUC", [1, None, None], False, False, "stale_memory"),
        ("SUC", [1, 2, None], False, False, "compression_collapse"),
        ("SUC", [1, 2, 3], False, False, "execution_failure"),
        ("S", [None], False, True, "reference_drift"),
        ("S", [4], False, True, "execution_failure"),
        ("", [], False, False, "execution_failure"),
    ],
)
def test_classes(
    operations: str, first_steps: list[int | None], success: bool, drift: bool, expected: str | None
) -> None:
    assert classify(operations, first_steps, success, drift) == expected


def test_a_task_brings_its_operations() -> None:
    task = get_task("turn_on_the_stove_and_turn_it_off")
    nothing = [None] * len(task.checkpoints)
    assert classify_failure(task, nothing, False) == classify(task.operations, nothing, False)


def test_logged_classes_win_and_missing_ones_are_derived() -> None:
    base = {"task": "t", "success": False, "checkpoints": [{"operation": "S", "first_step": None}]}
    assert failure_of({**base, "failure": "reference_drift"}) == "reference_drift"
    assert failure_of({**base, "failure": None}) == "storage_failure"
    assert failure_of(base) == "storage_failure"
    assert failure_of({**base, "success": True, "failure": "storage_failure"}) is None


def test_an_unknown_class_names_the_nearest() -> None:
    with pytest.raises(MemobenchError, match="storage_failure"):
        failure_of({"task": "t", "success": False, "checkpoints": [], "failure": "storage_failur"})


def test_every_class_is_counted() -> None:
    assert failure_counts([]) == dict.fromkeys(FAILURES, 0)
