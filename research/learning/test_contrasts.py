"""Arms against a reference: pairs, weights, and what a few training seeds leave open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from research.learning.results import contrasts


def records(solved: Sequence[Sequence[int]], kinds: Sequence[str] = ("object",)) -> list[dict[str, Any]]:
    """Rollouts of tasks in turn of the kinds given; ``solved`` holds 0 or 1 per task and episode."""
    return [
        {"task": f"task {t}", "memory_type": kinds[t % len(kinds)], "seed": 7 + k, "success": bool(one)}
        for t, task in enumerate(solved)
        for k, one in enumerate(task)
    ]


def test_tasks_and_types_weigh_the_same() -> None:
    """Three tasks of one type, one of another: the last weighs half."""
    base, other = [[0] * 8] * 4, [[1] * 8, [0] * 8, [0] * 8, [1] * 8]
    kinds = ("object", "object", "object", "procedural")
    found = contrasts({"none": [records(base, kinds)], "semantic": [records(other, kinds)]}, "none")
    assert list(found) == ["semantic"]
    assert found["semantic"].value == pytest.approx((1 / 3 + 1) / 2)


def test_a_steady_difference_shows_and_none_does_not() -> None:
    rng = np.random.default_rng(1)
    base = [rng.integers(0, 2, (2, 30)).tolist() for _ in range(3)]
    better = [[[1] * 30, task[1]] for task in base]
    arms = {"none": base, "better": better, "same": base}
    found = contrasts({name: [records(one) for one in runs] for name, runs in arms.items()}, "none")
    assert found["better"].low > 0
    assert found["better"].p < 0.01
    same = found["same"]
    assert (same.value, same.p, same.episodes) == (0, 1, 60)
    assert -0.1 < same.low < 0 < same.high < 0.1, "sixty equal pairs are no certainty"
    assert same.detectable is not None
    assert 0 < same.detectable < 0.2


def test_a_difference_of_one_training_is_none_of_arms() -> None:
    """One training seed in three solves all, the others what the reference does."""
    base = [[[0, 1] * 20]] * 3
    lucky = [[[1] * 40], base[1], base[2]]
    (found,) = contrasts({"a": [records(one) for one in base], "b": [records(one) for one in lucky]}, "a").values()
    assert found.value == pytest.approx(1 / 6)
    assert found.low == 0
    assert found.high > 0.3
    assert found.of_seeds == pytest.approx((0.5, 0, 0))
    assert found.p_of_seeds == pytest.approx(0.4226, abs=1e-4), "a paired t test: t = 1 with two degrees of freedom"


def test_equal_differences_say_nothing_of_training_seeds() -> None:
    """A t test of them has no variance to divide by; of two seeds they are equal now and then."""
    arms = {"a": [records([[0, 0, 1]])] * 3, "b": [records([[0, 1, 1]])] * 3, "c": [records([[0, 0, 1]])] * 3}
    found = contrasts(arms, "a")
    assert [one.p_of_seeds for one in found.values()] == [None, None]


def test_an_arm_is_the_same_whoever_stands_beside_it_but_for_holm() -> None:
    rng = np.random.default_rng(2)
    arms = {name: [records(rng.integers(0, 2, (2, 30)).tolist())] for name in "abc"} | {"d": [records([[1] * 30] * 2)]}
    alone, beside = contrasts({k: arms[k] for k in "ad"}, "a")["d"], contrasts(arms, "a")["d"]
    assert replace(beside, p=alone.p) == alone
    assert beside.p > alone.p


@pytest.mark.parametrize("ends", [(0, 0), (1, 1), (0, 1), (1, 0)])
def test_two_rollouts_leave_much_open(ends: tuple[int, int]) -> None:
    """All that a bootstrap draws from outcomes that are equal is equal."""
    arms = {name: [records([[end, end]])] for name, end in zip("ab", ends, strict=True)}
    (found,) = contrasts(arms, "a").values()
    assert found.value == ends[1] - ends[0]
    assert found.episodes == 2
    assert found.p_of_seeds is None, "one training says nothing about others"
    assert found.high - found.low > 0.6
    assert -1 <= found.low <= found.value <= found.high <= 1


def test_other_episodes_are_refused() -> None:
    with pytest.raises(MemobenchError, match="the arm 'b' has rolled out other episodes"):
        contrasts({"a": [records([[1, 0]])], "b": [records([[1, 0, 1]])]}, "a")
