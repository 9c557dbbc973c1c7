"""Formulas: parse, format and rename; tables of values over time, and properties of every formula."""

from __future__ import annotations

import itertools
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import (
    MAX_DEPTH,
    And,
    Atom,
    Exactly,
    Formula,
    Hold,
    Never,
    Not,
    Or,
    Round,
    Then,
    When,
    atoms,
    format_formula,
    parse_formula,
    rename,
    to_lists,
)
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator

A, B, C = Atom("on", ("a", "p")), Atom("open", ("d",)), Atom("handhome", ())
LATCH, IN_PLACE = Atom("wasopen", ("d",)), Atom("inplace", ("a",))
NUMBERS = st.integers(1, 4)


def _operators(inner: st.SearchStrategy[Formula]) -> st.SearchStrategy[Formula]:
    several = st.lists(inner, min_size=1, max_size=3).map(tuple)
    return st.one_of(
        *(several.map(kind) for kind in (And, Or, Then, Round)),
        *(inner.map(kind) for kind in (Not, Never)),
        *(st.builds(kind, NUMBERS, inner) for kind in (Hold, Exactly)),
        st.tuples(inner, inner).map(When),
    )


FORMULAS = st.recursive(st.sampled_from([A, B, C, LATCH, IN_PLACE]), _operators, max_leaves=8)


def as_objects(formula: Formula) -> Any:
    """Return a formula in JSON objects, with bare atoms as lists."""
    head, *rest = to_lists(formula)
    return [head, *rest] if isinstance(formula, Atom) else {head.upper(): rest}


@given(FORMULAS)
def test_json_forms_are_equal_and_round_trip(formula: Formula) -> None:
    assert parse_formula(to_lists(formula)) == parse_formula(as_objects(formula)) == formula
    words = format_formula(formula).replace("(", " ").replace(")", " ").lower().split()
    assert words == str(to_lists(formula)).replace("[", " ").replace("]", " ").replace(",", "").replace("'", "").split()


def test_rename_is_simultaneous() -> None:
    other = Atom("on", ("b", "p"))
    assert rename(And((A, Not(other))), {"a": "b", "b": "a"}) == And((other, Not(A)))
    assert rename(Exactly(2, A), {"a": "b"}) == Exactly(2, other)
    assert [atom.args[0] for atom in atoms(Then((A, Or((other, Not(A))))))] == ["a", "b", "a"]


@pytest.mark.parametrize(
    ("value", "fragment"),
    [
        (["onn", "a", "b"], "'onn'"),
        (["on", "a"], "expected 2"),
        (["on", "a", "a"], "twice"),
        (["not", ["open", "a"], ["open", "b"]], "exactly one"),
        (["when", ["open", "d"]], "exactly two"),
        (["exactly", ["open", "d"]], "without a number"),
        (["exactly", 0, ["open", "d"]], "found 0 after"),
        (["and", 2, ["open", "d"]], "found 2, expected a formula"),
        ({"and": [], "or": []}, "2 keys"),
        ({"on": ["a", "b"]}, "the key 'on'"),
        (["on", "a", ["b"]], "an entity name"),
    ],
)
def test_malformed_formula_is_one_clear_error(value: Any, fragment: str) -> None:
    with pytest.raises(MemobenchError, match=r"^here: found ") as error:
        parse_formula(value, "here")
    assert fragment in str(error.value)
    assert "\n" not in str(error.value)


def test_depth_is_bounded() -> None:
    value: Any = ["open", "a"]
    for _ in range(MAX_DEPTH + 1):
        value = ["not", value]
    with pytest.raises(MemobenchError, match="nested deeper"):
        parse_formula(value)


# --- formulas over time ---

BY_LETTER = {"a": A, "b": B, "c": C}
STATES = st.lists(st.sets(st.sampled_from([A, B, C, IN_PLACE])), min_size=1, max_size=30)


def values(formula: Formula, text: str, hold_steps: int = 2) -> str:
    """Return the values step by step (1 or 0), with * after each step in which the value is settled.

    ``text``: one word per step, a letter per true atom, ``-`` for none.
    """
    evaluator, found = Evaluator([formula], hold_steps), ""
    for state in ({BY_LETTER[letter] for letter in word if letter != "-"} for word in text.split()):
        (value,), (settled,) = evaluator.step(state.__contains__), evaluator.settled
        found += ("1" if value else "0") + ("*" if settled is not None else "")
        assert settled in (None, value)
    return found


@pytest.mark.parametrize(
    ("formula", "states", "expected"),
    [
        (Exactly(1, A), "- a a - - a a -", "011110*0*0*"),
        (Exactly(2, A), "a - - a - a", "000110*"),
        (Hold(3, A), "a a a a - a a a", "00110001"),
        (LATCH, "- b - -", "01*1*1*"),
        (When((A, B)), "- b ab - -", "001*1*1*"),
        (Round((A, B)), "b a - b b a b ab", "00010010"),
        (Round((A, B)), "ab ab", "01"),
        (Round((Hold(2, A), B)), "a a b a b a a b", "00100001"),
        (Exactly(2, Round((C, B, Not(B)))), "c b - b - c b -", "00000001"),
        (Or((Never(A), Never(B))), "- a b a", "110*0*"),
        (Never(And((LATCH, A))), "- b - a a", "1110*0*"),
        # Then: each child holds for two consecutive steps, in order; done children stay done.
        (Then((A,)), "a - a a", "0001*"),
        (Then((A, B)), "ab ab ab ab - -", "0001*1*1*"),
        (Then((A, B)), "b b b a a a", "000000"),
        (Then((A, B)), "b b a a b b", "000001*"),
        (Then((Never(A), B)), "- a b b", "00*0*0*"),
        # A nested Then holds for two steps itself, and starts after the child before it.
        (Then((A, Then((B, C)))), "abc abc abc abc abc abc abc", "0000001*"),
        (Then((A, Then((B, C)))), "b b c c a a c c c", "000000000"),
        # An operator inside others is updated in every step; latches also while their child is not evaluated.
        (Or((A, And((B, Then((C,)))))), "ac ac b", "111"),
        (Then((A, LATCH)), "b - a a - -", "000001*"),
    ],
)
def test_tables_of_states(formula: Formula, states: str, expected: str) -> None:
    assert values(formula, states) == expected


def test_default_hold_is_ten_steps() -> None:
    assert values(Then((A,)), "a " * 11, HOLD_STEPS) == "0" * 9 + "1*1*"


# --- properties of every formula ---


def follow(formula: Formula, states: list[set[Atom]]) -> tuple[list[bool], list[bool | None]]:
    evaluator = Evaluator([formula], hold_steps=3)
    pairs = [(evaluator.step(state.__contains__)[0], evaluator.settled[0]) for state in states]
    return [value for value, _ in pairs], [settled for _, settled in pairs]


@given(FORMULAS, STATES)
@settings(max_examples=300)
def test_settled_values_stay_and_shared_formulas_agree(formula: Formula, states: list[set[Atom]]) -> None:
    found, settled = follow(formula, states)
    for step, value in enumerate(settled):
        if value is not None:
            assert set(found[step:]) == {value}
            assert set(settled[step:]) == {value}
    evaluator = Evaluator([formula, Not(formula), formula], hold_steps=3)
    assert [evaluator.step(state.__contains__) for state in states] == [(v, not v, v) for v in found]


@given(FORMULAS, FORMULAS, NUMBERS, STATES)
def test_operators_equal_their_definitions(
    formula: Formula, condition: Formula, number: int, states: list[set[Atom]]
) -> None:
    found, steps = follow(formula, states)[0], range(len(states))
    rises = [now and not before for before, now in itertools.pairwise([False, *found])]
    assert follow(Never(formula), states)[0] == [not any(found[: k + 1]) for k in steps]
    assert follow(Exactly(number, formula), states)[0] == [sum(rises[: k + 1]) == number for k in steps]
    held = [k + 1 >= number and all(found[k + 1 - number : k + 1]) for k in steps]
    assert follow(Hold(number, formula), states)[0] == held
    when = follow(condition, states)[0]
    first = when.index(True) if True in when else len(states)
    assert follow(When((condition, formula)), states)[0] == [k >= first and found[first] for k in steps]
    latched = list(itertools.accumulate((B in state for state in states), max))
    assert follow(LATCH, states)[0] == latched
