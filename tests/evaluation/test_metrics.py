"""Metrics against logs made by hand, whose answers are known."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import (
    Rate,
    Summary,
    by_task,
    failure_counts,
    failure_of,
    faults,
    mean_rate,
    mean_row,
    mixtures,
    percent,
    policy_inputs,
    prefix,
    report_values,
    summarise,
    wilson,
)
from lerobot_memobench.evaluation.report_tables import inputs_sentence, pooled_sentence
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.catalogue import BOWL, get_task, task_names
from lerobot_memobench.tasks.failures import FAILURES, asks_order, classify, classify_failure
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
    assert report_values(summarise(LOG)) == {
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


def test_report_is_json() -> None:
    content = report_values(summarise(LOG))
    assert json.loads(json.dumps(content)) == content


def test_ordered_prefix_counts_only_what_came_in_order() -> None:
    late = rollout("t1", "temporal", "SU", [9, 3], True, ordered=[9, None])
    summary = summarise([late])
    assert [rate.value for rate in summary.prefix["t1"]] == [1.0, 1.0]
    assert [rate.value for rate in summary.ordered_prefix["t1"]] == [1.0, 0.0]


def test_pooled_rate_is_over_all_checkpoint_records() -> None:
    pooled = summarise(LOG).pooled
    assert pooled["SR"] == Rate(0.4, 10)
    assert pooled["MSR"] == Rate((3 + 3 + 1) / 10, 10)  # t1 4 records, t2 4, o1 2
    assert pooled["MUR"] == Rate((3 + 2) / 8, 8)
    assert pooled["MCR"] == Rate(0.5, 4)


def test_a_perfect_run_has_rates_where_they_apply() -> None:
    entry = report_values(summarise([rollout("t", "temporal", "SU", [1, 2], True)]))["average"]
    assert entry == {"n": 1, "SR": 100.0, "MSR": 100.0, "MUR": 100.0, "MCR": None}


def test_tasks_are_ordered_by_memory_type_and_name() -> None:
    assert list(by_task(reversed(LOG))) == ["t1", "t2", "s1", "o1"]


def test_an_empty_log_is_an_error() -> None:
    with pytest.raises(MemobenchError, match="no rollouts"):
        summarise([])


def test_versions_of_a_task_are_not_mixed() -> None:
    with pytest.raises(MemobenchError, match="operations"):
        by_task([rollout("t", "temporal", "S", [1], True), rollout("t", "temporal", "U", [1], True)])
    with pytest.raises(MemobenchError, match="memory_type"):
        by_task([rollout("t", "temporal", "S", [1], True), rollout("t", "object", "S", [1], True)])
    with pytest.raises(MemobenchError, match="one of temporal, spatial, object, procedural"):
        by_task([rollout("t", "musical", "S", [1], True)])


def test_mixed_protocols_are_said() -> None:
    assert mixtures(LOG) == []
    mixed = [*LOG, rollout("t2", "temporal", "SS", [1, 2], True, 0, referent="random", replan_steps=20)]
    referents, intervals = mixtures(mixed)
    assert "fixed, random" in referents
    assert "20, 5" in intervals


def test_lines_of_two_scenes_two_inputs_or_of_nobody_are_said() -> None:
    """Of one policy, by other lines of it or by none."""
    whose = {"policy": "act 1", "run": "1", "inputs": "pixels"}
    mine = [rollout("t", "temporal", "S", [1], True, k, **whose) for k in range(3)]
    assert mixtures(mine) == []
    (seeds,) = mixtures([*mine, rollout("t", "temporal", "S", [1], True, 3, **{**whose, "seed": 5002})])
    assert "seeds of episode 0 (7, 4999)" in seeds
    (seen,) = mixtures([*mine, rollout("t", "temporal", "S", [1], True, 3, **{**whose, "inputs": "poses"})])
    assert "policy inputs (pixels, poses)" in seen
    nobodys = [rollout("t", "temporal", "S", [1], True, 3 + k) for k in range(2)]
    assert mixtures(nobodys) == [], "nothing is mixed"
    assert mixtures([*mine, *nobodys])[0].startswith("2 rollouts of 5 do not say whose they are;")
    without_run = {"policy": "act 1", "inputs": "pixels"}
    (one,) = mixtures([*mine, rollout("t", "temporal", "S", [1], True, 3, **without_run)])
    assert one.startswith("1 rollout of 4 does not say whose it is;")


def test_one_is_no_plural_and_what_is_unknown_is_no_thing_seen() -> None:
    one = rollout("t", "temporal", "S", [1], True, fault="NaN")
    assert "1 rollout was broken off and counts as failed" in faults([one])[0]
    assert "(1 record)" in pooled_sentence(summarise([one]))
    told = policy_inputs([{**one, "inputs": "privileged object state"}, one])
    assert told == "privileged object state; of 1 rollout it is not recorded"
    assert inputs_sentence(told) == f"Policy inputs: {told}."
    assert inputs_sentence(policy_inputs([one])) == "Policy inputs: not recorded."
    assert inputs_sentence("pixels") == "Policy inputs: pixels."


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    # Newcombe (1998), method 3 (Wilson without continuity correction).
    [(81, 263, 0.2553, 0.3662), (15, 148, 0.0624, 0.1605), (0, 20, 0.0000, 0.1611), (1, 29, 0.0061, 0.1718)],
)
def test_wilson_intervals_of_the_literature(successes: int, n: int, low: float, high: float) -> None:
    assert wilson(successes / n, n) == pytest.approx((low, high), abs=5e-5)


@pytest.mark.parametrize("n", [1, 7, 40, 1500])
def test_wilson_intervals_are_those_of_statsmodels(n: int) -> None:
    from statsmodels.stats.proportion import proportion_confint

    for successes in range(0, n + 1, max(1, n // 20)):
        assert wilson(successes / n, n) == pytest.approx(proportion_confint(successes, n, method="wilson"), abs=1e-12)


@given(st.integers(1, 500), st.data())
def test_wilson_interval_holds_the_rate(n: int, data: st.DataObject) -> None:
    rate = data.draw(st.integers(0, n)) / n
    low, high = wilson(rate, n)
    assert 0.0 <= low <= rate + 1e-12
    assert rate - 1e-12 <= high <= 1.0
    assert not math.isclose(low, high)


def test_a_prefix_ends_at_the_first_that_is_missing() -> None:
    assert prefix([True, True, False, True]) == [True, True, False, False]
    assert prefix([]) == []


def test_percentages_have_one_decimal() -> None:
    assert percent(2 / 3) == 66.7
    assert percent(None) is None


def test_a_mean_has_the_interval_of_its_standard_error() -> None:
    # Var = p(1 - p)(1/80 + 3/40) / 16, that of a plain rate over 16 / 0.0875 rollouts.
    mean = mean_rate([Rate(0.5, 80), Rate(0.5, 40), Rate(0.5, 40), Rate(0.5, 40), Rate(None, 0)])
    assert mean.n == 200
    assert mean.trials == pytest.approx(16 / 0.0875)
    assert mean.interval == pytest.approx(wilson(0.5, 16 / 0.0875))
    assert mean_rate([Rate(0.25, 50), Rate(0.75, 50)]) == Rate(0.5, 100)


# --- the paper's own tables ---


def test_the_papers_averages_follow_from_its_memory_types() -> None:
    for published in published_rows():
        rows = [
            {metric: Rate(None if value is None else value / 100, 0) for metric, value in figures.items()}
            for figures in published.memory_types.values()
        ]
        for metric, rate in mean_row(rows).items():
            assert rate.value is not None
            assert 100 * rate.value == pytest.approx(published.average[metric], abs=0.1001), (published.model, metric)


# A log of 200 episodes made by hand. Every expected figure is a count worked out on paper, given beside it.

Steps = tuple[int | None, ...]

#: (task, memory type, operations) -> groups of (episodes, first steps, ordered steps, success, logged failure).
#: Where the failure is None although the episode failed, it has to be derived.
GROUPS: dict[tuple[str, str, str], list[tuple[int, Steps, Steps, bool, str | None]]] = {
    ("count", "temporal", "SUC"): [
        (10, (5, 9, 12), (5, 9, 12), True, None),
        (8, (None, 4, None), (None, None, None), False, "storage_failure"),
        (6, (5, None, None), (5, None, None), False, "stale_memory"),
        (4, (5, None, 12), (5, None, None), False, None),  # the last one came true alone: still stale
        (7, (5, 9, None), (5, 9, None), False, "compression_collapse"),
        (5, (9, 5, 12), (9, None, None), False, "execution_failure"),  # all came true, in the wrong order
    ],
    ("switch", "temporal", "SSU"): [
        (20, (3, 6, 8), (3, 6, 8), True, None),
        (12, (3, None, None), (3, None, None), False, None),
        (8, (3, 6, None), (3, 6, None), False, "stale_memory"),
    ],
    ("drawer", "spatial", "SC"): [
        (30, (0, 7), (0, 7), True, None),  # step 0 is a step
        (6, (2, None), (2, None), False, None),
        (4, (2, 7), (2, 7), False, None),
    ],
    ("pick", "object", "S"): [
        (22, (40,), (40,), True, None),
        (9, (None,), (None,), False, "reference_drift"),
        (5, (None,), (None,), False, None),
        (4, (40,), (40,), False, "execution_failure"),
    ],
    ("swap", "procedural", "SUU"): [
        (16, (1, 2, 3), (1, 2, 3), True, None),
        (10, (1, None, None), (1, None, None), False, None),
        (8, (1, 2, None), (1, 2, None), False, "stale_memory"),
        (6, (None, None, None), (None, None, None), False, None),
    ],
}


def log() -> list[dict[str, Any]]:
    records = []
    for (task, memory_type, operations), groups in GROUPS.items():
        episode = 0
        for count, first, ordered, success, failure in groups:
            for _ in range(count):
                known = {
                    "prompt_steps": 0,
                    "steps": 1200,
                    "failure": failure,
                    "scene_hash": f"{task}{episode}",
                    "wall_s": 1.0,
                }
                records.append(
                    rollout(task, memory_type, operations, list(first), success, episode, list(ordered), **known)
                )
                episode += 1
    return records


@pytest.fixture(scope="module")
def summary() -> Summary:
    records = log()
    assert len(records) == 200
    return summarise(records)


def test_tasks(summary: Summary) -> None:
    tasks = report_values(summary)["tasks"]
    # 10 of 40; S 10+6+4+7+5 = 32, U 10+8+7+5 = 30, C 10+4+5 = 19.
    assert tasks["count"] == {"n": 40, "SR": 25.0, "MSR": 80.0, "MUR": 75.0, "MCR": 47.5}
    # 20 of 40; S 2·20+12+2·8 = 68 of 80, U 20 of 40, no C.
    assert tasks["switch"] == {"n": 40, "SR": 50.0, "MSR": 85.0, "MUR": 50.0, "MCR": None}
    # 30 of 40; S 40, C 34, no U.
    assert tasks["drawer"] == {"n": 40, "SR": 75.0, "MSR": 100.0, "MUR": None, "MCR": 85.0}
    # 22 of 40; S 26.
    assert tasks["pick"] == {"n": 40, "SR": 55.0, "MSR": 65.0, "MUR": None, "MCR": None}
    # 16 of 40; S 34, U 2·16+8 = 40 of 80.
    assert tasks["swap"] == {"n": 40, "SR": 40.0, "MSR": 85.0, "MUR": 50.0, "MCR": None}


def test_memory_types_and_average(summary: Summary) -> None:
    content = report_values(summary)
    # Means of two tasks, but for MCR, which only one of them has.
    assert content["memory_types"]["temporal"] == {"n": 80, "SR": 37.5, "MSR": 82.5, "MUR": 62.5, "MCR": 47.5}
    assert content["memory_types"]["spatial"]["MUR"] is None
    # (37.5+75+55+40)/4, (82.5+100+65+85)/4, (62.5+50)/2, (47.5+85)/2: each memory type weighs the same.
    average = summary.average
    expected = {"SR": 0.51875, "MSR": 0.83125, "MUR": 0.5625, "MCR": 0.6625}
    assert {metric: rate.value for metric, rate in average.items()} == pytest.approx(expected)
    assert {metric: rate.n for metric, rate in average.items()} == {"SR": 200, "MSR": 200, "MUR": 120, "MCR": 80}


def test_failures(summary: Summary) -> None:
    assert summary.failures == {
        "storage_failure": 8 + 12 + 5 + 6,
        "stale_memory": 6 + 4 + 8 + 10 + 8,
        "compression_collapse": 7 + 6,
        "reference_drift": 9,
        "execution_failure": 5 + 4 + 4,
    }
    assert sum(summary.failures.values()) + 98 == 200
    assert summary.failures_of["pick"]["reference_drift"] == 9
    assert summary.failures_of["swap"]["stale_memory"] == 18


def test_prefix_in_any_order(summary: Summary) -> None:
    assert report_values(summary)["prefix"] == {
        "count": [80.0, 55.0, 37.5],  # 32; 10+7+5 = 22; 10+5 = 15
        "switch": [100.0, 70.0, 50.0],
        "drawer": [100.0, 85.0],
        "pick": [65.0],
        "swap": [85.0, 60.0, 40.0],
    }


def test_prefix_in_order(summary: Summary) -> None:
    ordered = {name: [rate.value for rate in rates] for name, rates in summary.ordered_prefix.items()}
    assert ordered["count"] == [0.8, 0.425, 0.25]  # 32; 10+7 = 17; 10
    assert ordered["switch"] == [1.0, 0.7, 0.5]


def test_pooled(summary: Summary) -> None:
    pooled = {metric: (rate.value, rate.n) for metric, rate in summary.pooled.items()}
    assert pooled == {
        "SR": (98 / 200, 200),
        "MSR": ((32 + 68 + 40 + 26 + 34) / 240, 240),
        "MUR": ((30 + 20 + 40) / 160, 160),
        "MCR": ((19 + 34) / 80, 80),
    }
    assert (summary.pooled_checkpoints.value, summary.pooled_checkpoints.n) == (343 / 480, 480)


def test_wilson_interval_of_20_in_40(summary: Summary) -> None:
    # centre 1/2; half width 1.959964·√(0.25/40 + 3.841459/6400) / (1 + 3.841459/40) = 0.148005
    interval = summary.tasks["switch"]["SR"].interval
    assert interval == pytest.approx((0.351995, 0.648005), abs=1e-6)


# The failure taxonomy.


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
    assert failure_of({**base, "success": True, "failure": None}) is None
    with pytest.raises(MemobenchError, match="is a success and has the failure class 'storage_failure'"):
        failure_of({**base, "success": True, "failure": "storage_failure"})


def test_an_unknown_class_names_the_nearest() -> None:
    with pytest.raises(MemobenchError, match="storage_failure"):
        failure_of({"task": "t", "success": False, "checkpoints": [], "failure": "storage_failur"})


def test_every_class_is_counted() -> None:
    assert failure_counts([]) == dict.fromkeys(FAILURES, 0)
    record = {"task": "t", "success": False, "checkpoints": [], "failure": "cut_off"}
    assert failure_counts([record]) == {**dict.fromkeys(FAILURES, 0), "cut_off": 1}
