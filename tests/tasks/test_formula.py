"""Formulas: walked through, renamed, and read from JSON."""

from __future__ import annotations

from typing import Any

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import (
    MAX_DEPTH,
    And,
    Atom,
    Not,
    Or,
    Then,
    atoms,
    format_formula,
    parse_formula,
    rename,
)

A, B, C = Atom("on", ("a", "p")), Atom("on", ("b", "p")), Atom("open", ("d",))


def test_rename_is_simultaneous() -> None:
    assert rename(And((A, Not(B))), {"a": "b", "b": "a"}) == And((B, Not(A)))
    assert [atom.args[0] for atom in atoms(Then((A, Or((B, Not(A))))))] == ["a", "b", "a"]


def test_parse_reads_lists_and_objects_in_any_case() -> None:
    expected = And((A, Not(Or((B, C))), Then((Atom("wasturnedon", ("s",)), Atom("turnoff", ("s",))))))
    lists = [
        "AND",
        ["On", "a", "p"],
        ["Not", ["or", ["ON", "b", "p"], ["Open", "d"]]],
        ["Then", ["WasTurnedon", "s"], ["Turnoff", "s"]],
    ]
    mixed = {
        "and": [
            ["on", "a", "p"],
            {"not": {"or": [["on", "b", "p"], ["open", "d"]]}},
            {"THEN": [["wasTurnedOn", "s"], ["turnoff", "s"]]},
        ]
    }
    assert parse_formula(lists) == parse_formula(mixed) == expected
    assert format_formula(expected) == (
        "(And (On a p) (Not (Or (On b p) (Open d))) (Then (WasTurnedOn s) (TurnOff s)))"
    )


def test_operator_over_a_bare_atom() -> None:
    assert parse_formula({"not": ["on", "a", "p"]}) == parse_formula({"not": [["on", "a", "p"]]}) == Not(A)
    assert parse_formula({"and": ["on", "a", "p"]}) == And((A,))


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (["onn", "a", "b"], "unknown predicate or operator 'onn'"),
        (["on", "a"], "expected 2 entity"),
        (["open", "a", "b"], "expected 1 entity"),
        (["on", "a", "a"], "twice"),
        (["and"], "nothing in it"),
        ({"or": []}, "nothing in it"),
        (["not", ["open", "a"], ["open", "b"]], "exactly one"),
        ({"and": [], "or": []}, "2 keys"),
        ({"on": ["a", "b"]}, "the key 'on'"),
        ({"and": "open"}, "expected a list of formulas"),
        ({"and": 3}, "expected a list of formulas"),
        (["on", "a", ["b"]], "expected an entity name"),
        (["on", "a", ""], "expected an entity name"),
        ("open a", "expected a formula"),
        ([], "expected a formula"),
        ([["on", "a", "b"]], "expected a formula"),
        (None, "expected a formula"),
        (7, "expected a formula"),
    ],
)
def test_malformed_formula_is_one_clear_error(value: Any, words: str) -> None:
    with pytest.raises(MemobenchError, match=r"^here: found ") as error:
        parse_formula(value, "here")
    assert words in str(error.value)
    assert "\n" not in str(error.value)


def test_depth_is_bounded() -> None:
    value: Any = ["open", "a"]
    for _ in range(MAX_DEPTH + 1):
        value = ["not", value]
    with pytest.raises(MemobenchError, match="nested deeper"):
        parse_formula(value)
