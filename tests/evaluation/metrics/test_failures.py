"""The failure taxonomy."""

from __future__ import annotations

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics.failures import failure_counts, failure_of
from lerobot_memobench.tasks.catalogue import BOWL, get_task, task_names
from lerobot_memobench.tasks.failures import FAILURES, asks_order, classify, classify_failure


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


PROCEDURES = [name for name in task_names("procedural") if asks_order(get_task(name).goal)]


@pytest.mark.parametrize(
    ("first_steps", "expected"),
    [
        ([None, 40], "wrong_order"),
        ([90, 40], "wrong_order"),
        ([40, None], "stale_memory"),
        ([None, None], "storage_failure"),
        ([40, 90], "execution_failure"),
        ([40, 40], "execution_failure"),
    ],
)
def test_a_procedure_in_another_order_is_a_memorys_failure(first_steps: list[int | None], expected: str) -> None:
    names = [*PROCEDURES, *(name for name in task_names("procedural", "strict"))]
    assert len(names) == 4 + 5, "one published goal leaves the order open"
    for name in names:
        task = get_task(name)
        steps = [*first_steps, *[max(filter(None, first_steps), default=None)] * (len(task.checkpoints) - 2)]
        if None in first_steps[1:]:
            steps = [*first_steps, *[None] * (len(task.checkpoints) - 2)]
        assert classify_failure(task, steps, False) == expected, name
        assert classify_failure(task, steps, True) is None
    free = get_task("execute_the_assembly_procedure_demonstrated_in_the_prompt_video")
    assert classify_failure(free, [90, 40], False) == "execution_failure"
    assert classify_failure(free.variant(1), [90, 40], False) == "wrong_order"
    temporal = get_task("turn_on_the_stove_and_turn_it_off")
    assert classify_failure(temporal, [None, 40], False) == "storage_failure", "its order is no prompt's"


def test_a_horizon_below_the_protocols_is_no_failure_of_memory() -> None:
    task = get_task("turn_on_the_stove_and_turn_it_off")
    assert classify_failure(task, [40, None], False, cut_off=True) == "cut_off"
    assert classify_failure(task, [40, None], False) == "stale_memory"
    assert classify_failure(task, [40, 50], False, cut_off=True) == "execution_failure"
    assert classify_failure(task, [40, 50], True, cut_off=True) is None
    bowl = get_task(BOWL)
    assert classify_failure(bowl, [None], False, drift=True, cut_off=True) == "reference_drift", "what is known counts"
    procedure = get_task(PROCEDURES[0])
    assert classify_failure(procedure, [None, 40], False, cut_off=True) == "wrong_order"


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
    record = {"task": "t", "success": False, "checkpoints": [], "failure": "cut_off"}
    assert failure_counts([record]) == {**dict.fromkeys(FAILURES, 0), "cut_off": 1}
