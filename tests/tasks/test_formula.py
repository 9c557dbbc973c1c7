"""Formulas: traverse, rename, format, and parse from JSON."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
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
        (["exactly", 2], "Exactly"),
        (["not", ["open", "a"], ["open", "b"]], "exactly one"),
        (["when", ["open", "d"]], "exactly two"),
        (["exactly", ["open", "d"]], "without a number"),
        (["exactly", 0, ["open", "d"]], "found 0 after"),
        (["hold", True, ["open", "d"]], "found True after"),
        (["and", 2, ["open", "d"]], "found 2, expected a formula"),
        ({"and": [], "or": []}, "2 keys"),
        ({"on": ["a", "b"]}, "the key 'on'"),
        (["on", "a", ["b"]], "an entity name"),
        ("open a", "expected a formula"),
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
