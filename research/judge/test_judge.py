"""Near misses get the right verdict.

``tests/sim/test_world.py`` tests predicates on both sides of their thresholds, ``tests/sim/test_libero.py`` equality
with LIBERO's predicates, ``research/necessity/test_adversaries.py`` strategies against strict tasks.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from lerobot_memobench.tasks.catalogue import task_names
from research.judge.__main__ import Row, rows_of, table

PAGE = Path(__file__).parents[2] / "docs" / "benchmark" / "judge.md"
KNOWN = {
    ("published", "one repetition more"),
    ("published", "order exchanged"),
    ("published", "moved without the hand"),
    ("strict", "moved without the hand"),
    ("strict", "held 2 cm above the target"),
}
"""Suite and kind of near misses that the definitions of goals accept, as the page states."""
COUNTING = "turn_the_stove_on_and_off_a_given_number_of_times"
PLACING = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
FEW = [COUNTING, PLACING]
"""Tasks of the default tests."""


@cache
def rows(name: str) -> list[Row]:
    return rows_of(name)


def of_all(names: list[str]) -> list[object]:
    return [pytest.param(name, marks=() if name in FEW else pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", of_all(task_names(suite=None)))
def test_near_misses_get_the_right_verdict(name: str) -> None:
    assert {row.right for row in rows(name)} == {True, False}
    wrong = {(row.suite, row.kind) for row in rows(name) if row.right != row.given}
    assert wrong <= KNOWN


@pytest.mark.slow
def test_page_has_the_table() -> None:
    every = [row for name in task_names(suite=None) for row in rows(name)]
    assert table(every) in PAGE.read_text(encoding="utf-8")
