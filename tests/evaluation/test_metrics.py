"""Metrics against logs made by hand, whose answers are known."""

from __future__ import annotations

from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import (
    Rate,
    by_task,
    failure_counts,
    failure_of,
    mean_rate,
    report_values,
    summary_of,
    wilson,
)
from lerobot_memobench.tasks.assessment import FAILURES, asks_order, classify, classify_failure
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.support.logs import record


def rollout(
    task: str,
    memory_type: str,
    operations: str,
    first: list[int | None],
    success: bool,
    episode: int = 0,
    ordered: list[int | None] | None = None,
    **changes: Any,
) -> dict[str, Any]:
    marks = zip(operations, first, first if ordered is None else ordered, strict=True)
    return record(task, episode, marks, memory_type=memory_type, success=success, **changes)


#: 4 rollouts of a temporal task, 2 of another, 2 of a spatial one and 2 of an object one.
LOG = [
    rollout("t1", "temporal", "SUC", [10, 20, 30], True, 0),
    rollout("t1", "temporal", "SUC", [10, 20, None], False, 1),
    rollout("t1", "temporal", "SUC", [10, None, 30], False, 2, ordered=[10, None, None]),
    rollout("t1", "temporal", "SUC", [None, 5, None], False, 3, ordered=[None, None, None]),
    rollout("t2", "temporal", "SS", [4, 9], True, 0),
    rollout("t2", "temporal", "SS", [4, None], False, 1),
    rollout("s1", "spatial", "UU", [1, 2], True, 0),
    rollout("s1", "spatial", "UU", [None, None], False, 1),
    rollout("o1", "object", "S", [50], True, 0),
    rollout("o1", "object", "S", [None], False, 1, failure="reference_drift"),
]


def test_report_of_the_hand_made_log() -> None:
    assert report_values(summary_of(LOG)) == {
        "tasks": {
            "t1": {"n": 4, "SR": 25.0, "MSR": 75.0, "MUR": 75.0, "MCR": 50.0},
            "t2": {"n": 2, "SR": 50.0, "MSR": 75.0, "MUR": None, "MCR": None},
            "s1": {"n": 2, "SR": 50.0, "MSR": None, "MUR": 50.0, "MCR": None},
            "o1": {"n": 2, "SR": 50.0, "MSR": 50.0, "MUR": None, "MCR": None},
        },
        "memory_types": {
            "temporal": {"n": 6, "SR": 37.5, "MSR": 75.0, "MUR": 75.0, "MCR": 50.0},
            "spatial": {"n": 2, "SR": 50.0, "MSR": None, "MUR": 50.0, "MCR": None},
            "object": {"n": 2, "SR": 50.0, "MSR": 50.0, "MUR": None, "MCR": None},
        },
        "average": {"n": 10, "SR": 45.8, "MSR": 62.5, "MUR": 62.5, "MCR": 50.0},
        "failures": {
            "storage_failure": 2,
            "stale_memory": 2,
            "compression_collapse": 1,
            "reference_drift": 1,
            "execution_failure": 0,
        },
        "prefix": {"t1": [75.0, 50.0, 25.0], "t2": [100.0, 50.0], "s1": [50.0, 50.0], "o1": [50.0]},
        "inputs": "not recorded",
    }


def test_ordered_prefix_counts_only_what_came_in_order() -> None:
    late = rollout("t1", "temporal", "SU", [9, 3], True, ordered=[9, None])
    summary = summary_of([late])
    assert [rate.value for rate in summary.tasks["t1"].prefix] == [1.0, 1.0]
    assert [rate.value for rate in summary.tasks["t1"].ordered_prefix] == [1.0, 0.0]


def test_pooled_rate_is_over_all_checkpoint_records() -> None:
    pooled = summary_of(LOG).pooled
    assert pooled["SR"] == Rate(0.4, 10)
    assert pooled["MSR"] == Rate((3 + 3 + 1) / 10, 10)  # t1 4 records, t2 4, o1 2
    assert pooled["MUR"] == Rate((3 + 2) / 8, 8)
    assert pooled["MCR"] == Rate(0.5, 4)


def test_versions_of_a_task_are_not_mixed() -> None:
    with pytest.raises(MemobenchError, match="operations"):
        by_task([rollout("t", "temporal", "S", [1], True), rollout("t", "temporal", "U", [1], True)])
    with pytest.raises(MemobenchError, match="memory_type"):
        by_task([rollout("t", "temporal", "S", [1], True), rollout("t", "object", "S", [1], True)])
    with pytest.raises(MemobenchError, match="one of temporal, spatial, object, procedural"):
        by_task([rollout("t", "musical", "S", [1], True)])


@pytest.mark.parametrize("n", [1, 40])
def test_wilson_intervals_are_those_of_statsmodels(n: int) -> None:
    from statsmodels.stats.proportion import proportion_confint

    for successes in range(0, n + 1, max(1, n // 20)):
        assert wilson(successes / n, n) == pytest.approx(proportion_confint(successes, n, method="wilson"), abs=1e-12)


def test_a_mean_has_the_interval_of_its_standard_error() -> None:
    # Var = p(1 - p)(1/80 + 3/40) / 16, that of a plain rate over 16 / 0.0875 rollouts.
    mean = mean_rate([Rate(0.5, 80), Rate(0.5, 40), Rate(0.5, 40), Rate(0.5, 40), Rate(None, 0)])
    assert mean.n == 200
    assert mean.trials == pytest.approx(16 / 0.0875)
    assert mean.interval == pytest.approx(wilson(0.5, 16 / 0.0875))
    assert mean_rate([Rate(0.25, 50), Rate(0.75, 50)]) == Rate(0.5, 100)


# The failure taxonomy.


@pytest.mark.parametrize(
    ("operations", "first_steps", "success", "drift", "expected"),
    [
        ("SUC", [1, 2, 3], True, False, None),
        ("SUC", [None, None, None], True, True, None),  # the goal holds without its checkpoints
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
    basket = get_task(task_names(suite="libero_object")[0])
    assert classify_failure(basket, [], False, cut_off=True) == "cut_off", "it has no checkpoints"
    assert classify_failure(basket, [], False) == "execution_failure"
    bowl = get_task("put_the_butter_into_the_bowl_from_the_prompt_video")
    assert classify_failure(bowl, [None], False, drift=True, cut_off=True) == "reference_drift", "what is known counts"
    procedure = get_task(PROCEDURES[0])
    assert classify_failure(procedure, [None, 40], False, cut_off=True) == "wrong_order"


def test_logged_classes_win_and_missing_ones_are_derived() -> None:
    base = {"task": "t", "success": False, "checkpoints": [{"operation": "S", "first_step": None}]}
    assert failure_of({**base, "failure": "reference_drift"}) == "reference_drift"
    assert failure_of({**base, "failure": None}) == "storage_failure"
    assert failure_of({**base, "success": True, "failure": None}) is None
    with pytest.raises(MemobenchError, match="is a success and has the failure class 'storage_failure'"):
        failure_of({**base, "success": True, "failure": "storage_failure"})
    with pytest.raises(MemobenchError, match="storage_failure"):
        failure_of({**base, "failure": "storage_failur"})
    assert failure_counts([{**base, "failure": "cut_off"}]) == {**dict.fromkeys(FAILURES, 0), "cut_off": 1}
