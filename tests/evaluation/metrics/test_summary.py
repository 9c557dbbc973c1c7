"""A log of 200 episodes made by hand. Every expected figure is a count worked out on paper, given beside it."""

from __future__ import annotations

from typing import Any

import pytest

from lerobot_memobench.evaluation.metrics.summary import Summary, report, summarise

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
                checkpoints = [
                    {"operation": operations[k], "first_step": first[k], "ordered_step": ordered[k]}
                    for k in range(len(operations))
                ]
                records.append(
                    {
                        "task": task,
                        "memory_type": memory_type,
                        "episode": episode,
                        "seed": 7 + episode,
                        "referent": "fixed",
                        "replan_steps": 5,
                        "prompt_steps": 0,
                        "steps": 1200,
                        "success": success,
                        "checkpoints": checkpoints,
                        "failure": failure,
                        "scene_hash": f"{task}{episode}",
                        "wall_s": 1.0,
                    }
                )
                episode += 1
    return records


@pytest.fixture(scope="module")
def summary() -> Summary:
    records = log()
    assert len(records) == 200
    return summarise(records)


def test_tasks(summary: Summary) -> None:
    tasks = report(summary)["tasks"]
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
    content = report(summary)
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
    assert report(summary)["prefix"] == {
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
