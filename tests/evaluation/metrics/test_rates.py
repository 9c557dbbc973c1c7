"""Metrics against logs made by hand, whose answers are known."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.documents.sentences import inputs_sentence, pooled_sentence
from lerobot_memobench.evaluation.metrics.rates import Rate, mean_rate, mean_row, percent, wilson
from lerobot_memobench.evaluation.metrics.rollouts import by_task, faults, mixtures, policy_inputs, prefix
from lerobot_memobench.evaluation.metrics.summary import report, summarise
from lerobot_memobench.paper import published_rows


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
    ordered = first if ordered is None else ordered
    return {
        "task": task,
        "memory_type": memory_type,
        "episode": episode,
        "seed": 7 + episode,
        "referent": "fixed",
        "replan_steps": 5,
        "success": success,
        "checkpoints": [
            {"operation": o, "first_step": f, "ordered_step": s}
            for o, f, s in zip(operations, first, ordered, strict=True)
        ],
        "failure": None,
        **changes,
    }


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
    assert report(summarise(LOG)) == {
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
    content = report(summarise(LOG))
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
    entry = report(summarise([rollout("t", "temporal", "SU", [1, 2], True)]))["average"]
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


def test_lines_of_two_scenes_two_eyes_or_of_nobody_are_said() -> None:
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


@given(st.lists(st.booleans(), max_size=8))
def test_prefix_is_the_running_product(values: list[bool]) -> None:
    assert prefix(values) == [all(values[: k + 1]) for k in range(len(values))]


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
