"""Near misses get the right verdict, and mutants of the judge are noticed.

``tests/sim/test_world.py`` tests predicates on both sides of their thresholds, ``tests/sim/test_libero.py`` equality
with LIBERO's predicates, ``research/necessity/test_adversaries.py`` strategies against strict tasks.
"""

from __future__ import annotations

import random
from functools import cache
from pathlib import Path

import pytest

from lerobot_memobench.tasks import progress
from lerobot_memobench.tasks.catalogue import task_names
from research.judge.__main__ import rows_of, table, variant_of
from research.judge.mutants import Battery, Mutant, is_not_shown, killer, mutants

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
OPERATORS = ("_AndNode", "_NeverNode", "_HoldNode", "_ExactlyNode", "_RoundNode", "_WhenNode")
"""Operators of `COUNTING`."""


@cache
def battery(name: str) -> Battery:
    """Return the judged cases of a task."""
    return Battery(variant_of(name))


def of_all(names: list[str]) -> list[object]:
    """Return parameters: a few tasks by default, the others as slow tests."""
    return [pytest.param(name, marks=() if name in FEW else pytest.mark.slow) for name in names]


@pytest.mark.parametrize("name", of_all(task_names(suite=None)))
def test_near_misses_get_the_right_verdict(name: str) -> None:
    rows = rows_of(battery(name))
    assert {row.right for row in rows} == {True, False}
    wrong = {(row.suite, row.kind) for row in rows if row.right != row.given}
    assert wrong <= KNOWN


def test_some_mutants_of_the_operators_are_killed() -> None:
    found = [mutant for mutant in mutants() if any(f"{name}.value" in mutant.name for name in OPERATORS)]
    chosen = random.Random(69).sample([mutant for mutant in found if not is_not_shown(mutant)], 10)
    batteries = [battery(name) for name in FEW]
    assert [mutant.name for mutant in chosen if killer(mutant, batteries) is None] == []


def test_a_judge_that_accepts_everything_is_killed() -> None:
    text = Path(str(progress.__file__)).read_text(encoding="utf-8")
    changed = text.replace("return self.success", "self.success = True\n        return True")
    assert changed != text
    assert killer(Mutant("accepts everything", progress, changed), [battery(PLACING)])


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_all_mutants_are_killed() -> None:
    batteries = [battery(name) for name in task_names(suite=None)]
    tried = [mutant for mutant in mutants() if not is_not_shown(mutant)]
    assert [mutant.name for mutant in tried if killer(mutant, batteries) is None] == []


@pytest.mark.slow
def test_page_has_the_table() -> None:
    rows = [row for name in task_names(suite=None) for row in rows_of(battery(name))]
    assert table(rows) in PAGE.read_text(encoding="utf-8")
