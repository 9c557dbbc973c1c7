"""Verdicts and bounds of the study, and rates of trained policies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from research.necessity.__main__ import necessity
from research.necessity.report import _bounds_of, bounds, in_words, verdict
from research.necessity.settings import settings_of, variants_of
from research.necessity.trained import read_evaluations, with_evaluations
from tests.support import logs
from tests.support.logs import write_log

STOVE, STRICT_TASK = "turn_on_the_stove_and_turn_it_off", "turn_the_stove_on_and_off_a_given_number_of_times"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"


def result(task: str, referent: str, found: float | None, confirmed: int = 0, cut_off: int = 0) -> dict[str, Any]:
    in_order = {"chance": 0.2, "deterministic": 1.0, "stochastic": 0.2, "pixel_exact": 0.0}
    in_order |= dict.fromkeys(("as_it_happens", "with_step"), 1.0 if found is None else 0.0)
    any_order = None
    if found is not None:
        in_order["deterministic"] = 0.0
        any_order = {"deterministic": found, "stochastic": 0.21, "confirmed": confirmed, "of": 9}
        any_order |= {"searches": 3, "cut_off": cut_off, "unexplored": 5 * cut_off}
    expert = {"n": 9, "success": 9}
    return {
        "task": task,
        "referent": referent,
        "variants": 3,
        "settings": {"budget": 10_000},
        "expert": expert,
        "in_order": in_order,
        "any_order": any_order,
    }


def test_bounds_and_verdicts_of_a_search() -> None:
    found = result(STRICT_TASK, "drawn", 1 / 3, 3)
    assert _bounds_of(found) == ["0.0", "0.0", "33.3 (3/9)", "21.0", "whole", ""]
    assert verdict(found) == "not found"
    assert "at most 33.3 %, on average 33.3 %" in bounds([found])
    cut = result(STRICT_TASK, "drawn", 1 / 3, 3, cut_off=2)
    assert verdict(cut) == "cut off"
    assert _bounds_of(cut)[4] == "cut off, 10 states left"
    assert "2 of 3 searches were cut off by their budget (10,000 control steps" in bounds([cut])
    assert verdict(result(STOVE, "fixed", None)) == "no"
    assert verdict(result(STOVE, "fixed", 0.5, 9)) == "order"
    assert bounds([result(STOVE, "fixed", 0.5, 9)]) == ""
    assert bounds([result(STRICT_TASK, "drawn", None)]) == ""


def test_rates_of_trained_policies_are_added(tmp_path: Path) -> None:
    lines = [
        logs.record(STRICT_TASK, k, referent="drawn", suite="strict", variant=k % 3, success=k < 2, policy="me")
        for k in range(6)
    ]
    write_log(tmp_path, lines)
    evaluated = read_evaluations([tmp_path])
    found, published = with_evaluations([result(STRICT_TASK, "drawn", 0.0), result(STOVE, "fixed", None)], evaluated)
    assert found["trained"] == {"policy": "me", "success": 2, "n": 6, "balanced": True}
    assert published["trained"] is None
    assert _bounds_of(found)[-1] == "33.3 [9.7–70.0] of 6"
    write_log(tmp_path / "few", lines[::3])
    (found,) = with_evaluations([result(STRICT_TASK, "drawn", 0.0)], read_evaluations([tmp_path / "few"]))
    assert _bounds_of(found)[-1].endswith("of 2, variants out of balance")


def test_folders_without_an_evaluation_are_refused_before_simulation(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="holds no episode log"):
        necessity(memoryless=[tmp_path], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_drawn_task_has_one_setting_and_all_its_goals() -> None:
    assert settings_of(get_task(STRICT_TASK), ("fixed", "random")) == ("drawn",)
    assert [variant.language for variant in variants_of(get_task(STRICT_TASK), "drawn")] == [
        variant.language for variant in map(get_task(STRICT_TASK).variant, range(3))
    ]
    assert settings_of(get_task(MILK), ("fixed", "random")) == ("fixed", "random")
    assert settings_of(get_task(STOVE), ("random",)) == ("fixed",)


@pytest.mark.parametrize(
    ("answer", "expected"),
    [
        ("(open wooden_cabinet_1_top_region)", "open the top drawer"),
        ("(On butter_5 plate_1)", "put butter 5 on plate"),
        ("(in butter_1 bowl_2)", "put butter into bowl 2"),
        ("rest", "rest"),
        ("(sequence a b)", "sequence a b"),
    ],
)
def test_answers_in_words(answer: str, expected: str) -> None:
    assert in_words(answer) == expected
