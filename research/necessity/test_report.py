"""What the study writes: its table in a page of the documentation, and published tasks beside their strict tasks."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from research.necessity.__main__ import necessity
from research.necessity.report import (
    STUDY,
    bounds,
    in_words,
    put_into_page,
    read_results,
    side_by_side,
    verdict,
)
from research.necessity.settings import settings_of, variants_of
from research.necessity.trained import read_evaluations, with_evaluations
from research.pages import END, begin
from tests.support import logs


def test_a_page_gets_the_table_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{begin(STUDY)}\nan old table\n{END}\nafter\n")
    text = put_into_page(page, []).read_text()
    assert text.startswith(f"before\n{begin(STUDY)}\n\n| task |")
    assert text.endswith(f"{END}\nafter\n")
    assert "an old table" not in text
    assert put_into_page(page, []).read_text() == text
    page.write_text("no marks")
    with pytest.raises(MemobenchError, match="put them where the table goes"):
        put_into_page(page, [])
    assert page.read_text() == "no marks"


@pytest.mark.parametrize("content", [None, b"no marks", b"\xff"])
def test_a_page_without_a_place_is_told_before_anything_is_simulated(tmp_path: Path, content: bytes | None) -> None:
    page = tmp_path / "page.md"
    if content is not None:
        page.write_bytes(content)
    with pytest.raises(MemobenchError, match=r"the page .*page\.md"):
        necessity(page=page, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- published and strict tasks in one table, and the settings of drawn tasks ---

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


def test_a_published_task_stands_beside_its_strict_task() -> None:
    table = side_by_side([result(STOVE, "fixed", None)], [result(STRICT_TASK, "drawn", 1 / 3, 3)])
    row = next(line for line in table.splitlines() if STRICT_TASK in line)
    found = "0.0 | 0.0 | 33.3 (3/9) | 21.0 | whole"
    assert row == f"| `{STOVE}` | 100.0 | no | `{STRICT_TASK}` | 3 | {found} |  | 9/9 | not found |"
    assert "Without a memory no way was found to 1 of 1 tasks. Lower bounds" in table
    assert "best fixed map in any order at most 33.3 %, on average 33.3 %" in table
    assert "| – | – | `" in side_by_side([], [result(STRICT_TASK, "drawn", 0.0)]), "published tasks may not be measured"


def test_a_search_that_was_cut_off_says_so() -> None:
    cut = result(STRICT_TASK, "drawn", 1 / 3, 3, cut_off=2)
    assert verdict(cut) == "cut off"
    assert "| cut off, 10 states left |" in side_by_side([], [cut])
    assert "2 of 3 searches were cut off by their budget (10,000 control steps for each" in bounds([cut])


def test_a_trained_policy_stands_beside_the_bounds(tmp_path: Path) -> None:
    lines = [
        logs.record(STRICT_TASK, k, referent="drawn", suite="strict", variant=k % 3, success=k < 2, policy="me")
        for k in range(6)
    ]
    write_episodes(tmp_path, lines)
    evaluated = read_evaluations([tmp_path])
    found, published = with_evaluations([result(STRICT_TASK, "drawn", 0.0), result(STOVE, "fixed", None)], evaluated)
    assert found["trained"] == {"policy": "me", "success": 2, "n": 6, "balanced": True}
    assert published["trained"] is None
    assert "| 33.3 [9.7–70.0] of 6 |" in side_by_side([], [found])
    write_episodes(tmp_path / "few", lines[::3])
    (found,) = with_evaluations([result(STRICT_TASK, "drawn", 0.0)], read_evaluations([tmp_path / "few"]))
    assert "of 2, variants out of balance |" in side_by_side([], [found])


def test_a_folder_without_an_evaluation_is_told_before_anything_is_simulated(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="holds no episode log"):
        necessity(memoryless=[tmp_path], out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bounds_are_told_of_drawn_tasks_that_were_searched() -> None:
    assert bounds([result(STOVE, "fixed", 0.5, 9)]) == ""
    assert bounds([result(STRICT_TASK, "drawn", None)]) == ""


def test_a_page_shows_both_when_it_is_told_of_the_published_results(tmp_path: Path) -> None:
    kept = tmp_path / "necessity.json"
    kept.write_text(json.dumps([result(STOVE, "fixed", None)]))
    page = tmp_path / "page.md"
    page.write_text(f"{begin(STUDY)}{END}")
    text = put_into_page(page, [result(STRICT_TASK, "drawn", 0.0)], read_results(kept)).read_text()
    assert f"| `{STOVE}` | 100.0 | no |" in text
    with pytest.raises(MemobenchError, match="there is no"):
        read_results(tmp_path / "missing.json")
    kept.write_text('[{"task": "a"}]')
    with pytest.raises(MemobenchError, match=r"name the necessity\.json"):
        read_results(kept)


def test_a_drawn_task_has_one_setting_and_all_its_goals() -> None:
    assert settings_of(get_task(STRICT_TASK), ("fixed", "random")) == ("drawn",)
    assert [variant.language for variant in variants_of(get_task(STRICT_TASK), "drawn")] == [
        variant.language for variant in map(get_task(STRICT_TASK).variant, range(3))
    ]
    assert settings_of(get_task(MILK), ("fixed", "random")) == ("fixed", "random")
    assert settings_of(get_task(STOVE), ("random",)) == ("fixed",)


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("(open wooden_cabinet_1_top_region)", "open the top drawer"),
        ("(On butter_5 plate_1)", "put butter 5 on plate"),
        ("(in butter_1 bowl_2)", "put butter into bowl 2"),
        ("rest", "rest"),
        ("(sequence a b)", "sequence a b"),
    ],
)
def test_answers_are_titles_and_no_predicates(answer: str, said: str) -> None:
    assert in_words(answer) == said
