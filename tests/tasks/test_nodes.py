"""Never, Hold, Exactly, When and Round: tables of states on paper, and what holds for every formula. No physics."""

from __future__ import annotations

import copy

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.formula import (
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
from lerobot_memobench.tasks.progress import Evaluator
from lerobot_memobench.tasks.sexpr import Reader

A, B, C = Atom("on", ("a", "p")), Atom("open", ("d",)), Atom("handhome", ())
LATCH = Atom("wasopen", ("d",))
BY_LETTER = {"a": A, "b": B, "c": C}


def world(text: str) -> list[set[Atom]]:
    """States from words: one word per step, a letter per atom that holds, ``-`` for none."""
    return [{BY_LETTER[letter] for letter in word if letter != "-"} for word in text.split()]


def values(formula: Formula, text: str) -> str:
    """What a formula says step by step: 1 or 0, and * for the steps after which its value is settled."""
    evaluator, said = Evaluator([formula], hold_steps=2), ""
    for state in world(text):
        (value,) = evaluator.step(state.__contains__)
        (settled,) = evaluator.settled
        said += ("1" if value else "0") + ("*" if settled is not None else "")
        assert settled in (None, value)
    return said


@pytest.mark.parametrize(
    ("formula", "states", "said"),
    [
        (Never(A), "- b a - -", "110*0*0*"),
        (Hold(3, A), "a a a a - a a a", "00110001"),
        (Hold(1, A), "a - a", "101"),
        (Exactly(1, A), "- a a - - a a -", "011110*0*0*"),
        (Exactly(2, A), "a - - a - a", "000110*"),
        (When((A, B)), "- b a b", "000*0*"),
        (When((A, B)), "- b ab - -", "001*1*1*"),
        (Round((A, B)), "b a - b b a b ab", "00010010"),
        (Round((A, B)), "ab ab", "01"),
        (Round((A,)), "a a - a", "1101"),
        (Exactly(2, Round((C, B, Not(B)))), "c b - b - c b -", "00000001"),
        (Not(Never(A)), "- a -", "01*1*"),
        (And((Never(B), A)), "a b a", "10*0*"),
        (Or((Never(B), A)), "- b a -", "1010"),
        (Or((Never(A), Never(B))), "- a b a", "110*0*"),
        (Never(And((LATCH, A))), "- b - a a", "1110*0*"),
        (Hold(2, LATCH), "- b - -", "001*1*"),
        (Exactly(1, LATCH), "- b - -", "01*1*1*"),
        (Then((Never(A), B)), "- - b b a", "0001*1*"),
        (Then((Never(A), B)), "- a b b", "00*0*0*"),
        (When((LATCH, Never(A))), "a b", "0*0*"),
    ],
)
def test_on_paper(formula: Formula, states: str, said: str) -> None:
    assert values(formula, states) == said


def test_a_new_round_begins_its_parts_anew() -> None:
    twice_held = Round((Hold(2, A), B))
    assert values(twice_held, "a a b a b a a b") == "00100001"


def test_counting_task_on_paper() -> None:
    """Twice, from home, then the first rest decides; a rest before the event is a rest too."""
    shut = Not(B)
    goal = When((Hold(3, And((C, shut))), And((Exactly(2, Round((C, B, shut))), Exactly(2, Round((B, shut)))))))
    once, twice = "c b - c ", "c b - c b - c "
    assert values(goal, twice + "c c").endswith("1*"), "two from home, then rest"
    assert values(goal, once + "c c").endswith("0*"), "stopped after one"
    assert values(goal, "c b - c b - c b - c c c").endswith("0*"), "went on to three"
    assert values(goal, "c c c").endswith("0*"), "did not begin"
    assert values(goal, "c b - b - c c c").endswith("0*"), "the hand was not home in between"
    assert values(goal, "c b - b - c b - c c c").endswith("0*"), "one of three was not from home"
    assert "1" not in values(goal, twice + "- - - c c"), "no rest, no success"


# --- reading and writing ---

_ATOMS = st.sampled_from([A, B, C, LATCH, Atom("inplace", ("a",))])
_NUMBERS = st.integers(1, 4)


def _operators(inner: st.SearchStrategy[Formula]) -> st.SearchStrategy[Formula]:
    several = st.lists(inner, min_size=1, max_size=3).map(tuple)
    return st.one_of(
        *(several.map(kind) for kind in (And, Or, Then, Round)),
        *(inner.map(kind) for kind in (Not, Never)),
        *(st.builds(kind, _NUMBERS, inner) for kind in (Hold, Exactly)),
        st.tuples(inner, inner).map(When),
    )


FORMULAS = st.recursive(_ATOMS, _operators, max_leaves=8)
STATES = st.lists(st.sets(st.sampled_from([A, B, C, Atom("inplace", ("a",))])), min_size=1, max_size=30)


@given(FORMULAS)
def test_json_and_bddl_round_trip(formula: Formula) -> None:
    assert parse_formula(to_lists(formula)) == formula
    assert parse_formula({to_lists(formula)[0]: to_lists(formula)[1:]}) == formula if list(_parts(formula)) else True
    text = format_formula(formula)
    Reader("formula", text).read()
    assert format_formula(parse_formula(_lists_of(text))) == text
    assert rename(formula, {"a": "b", "b": "a"}) != formula or not any(
        {"a", "b"} & set(atom.args) for atom in atoms(formula)
    )


def _parts(formula: Formula) -> list[Formula]:
    return [] if isinstance(formula, Atom) else [formula]


def _lists_of(text: str) -> list[object]:
    """The S-expression as nested lists, numbers as numbers."""
    stack: list[list[object]] = [[]]
    for token in text.replace("(", " ( ").replace(")", " ) ").split():
        if token == "(":
            stack.append([])
        elif token == ")":
            done = stack.pop()
            stack[-1].append(done)
        else:
            stack[-1].append(int(token) if token.isdigit() else token)
    (found,) = stack[0]
    assert isinstance(found, list)
    return found


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (["exactly", ["open", "d"]], "found Exactly without a number, expected a whole number from 1"),
        (["exactly", 0, ["open", "d"]], "found 0 after Exactly"),
        (["hold", True, ["open", "d"]], "found True after Hold"),
        (["hold", "3", ["open", "d"]], "found '3' after Hold"),
        (["exactly", 2], "Exactly with nothing in it"),
        (["exactly"], "Exactly without a number"),
        (["hold", [3], ["open", "d"]], "found [3], expected a formula"),
        (["hold", 2, ["open", "d"], ["open", "d"]], "Hold over 2 formulas, expected exactly one"),
        (["when", ["open", "d"]], "When over 1 formulas, expected exactly two"),
        (["never", ["open", "d"], ["open", "e"]], "Never over 2 formulas, expected exactly one"),
        (["handhome", "a"], "expected 0 entity name"),
        (["and", 2, ["open", "d"]], "found 2, expected a formula"),
    ],
)
def test_malformed_is_one_clear_error(value: object, words: str) -> None:
    with pytest.raises(MemobenchError, match=r"^here: found ") as error:
        parse_formula(value, "here")
    assert words in str(error.value)


# --- what holds for every formula ---


def follow(formula: Formula, states: list[set[Atom]]) -> tuple[list[bool], list[bool | None]]:
    evaluator = Evaluator([formula], hold_steps=3)
    said, settled = [], []
    for state in states:
        said.append(evaluator.step(state.__contains__)[0])
        settled.append(evaluator.settled[0])
    return said, settled


@given(FORMULAS, STATES)
@settings(max_examples=400)
def test_what_is_settled_stays(formula: Formula, states: list[set[Atom]]) -> None:
    said, settled = follow(formula, states)
    for step, value in enumerate(settled):
        if value is not None:
            assert set(said[step:]) == {value}
            assert set(settled[step:]) == {value}


@given(FORMULAS, STATES)
def test_never_only_falls_and_is_the_negation_of_ever(formula: Formula, states: list[set[Atom]]) -> None:
    never, _ = follow(Never(formula), states)
    said, _ = follow(formula, states)
    assert never == [not any(said[: k + 1]) for k in range(len(said))]


@given(FORMULAS, _NUMBERS, STATES)
def test_exactly_counts_what_came_true(formula: Formula, number: int, states: list[set[Atom]]) -> None:
    counted, settled = follow(Exactly(number, formula), states)
    said, _ = follow(formula, states)
    rises = [now and not before for before, now in zip([False, *said], said, strict=False)]
    assert counted == [sum(rises[: k + 1]) == number for k in range(len(said))]
    spells = sum(now and not before for before, now in zip([False, *counted], counted, strict=False))
    assert spells <= 1, "a count that has passed never comes back"
    assert all(
        value is False for value, k in zip(settled, range(len(said)), strict=True) if sum(rises[: k + 1]) > number
    )


@given(FORMULAS, _NUMBERS, STATES)
def test_hold_looks_at_the_last_steps(formula: Formula, number: int, states: list[set[Atom]]) -> None:
    held, _ = follow(Hold(number, formula), states)
    said, _ = follow(formula, states)
    assert held == [k + 1 >= number and all(said[k + 1 - number : k + 1]) for k in range(len(said))]


@given(FORMULAS, FORMULAS, STATES)
def test_when_is_decided_once(moment: Formula, then: Formula, states: list[set[Atom]]) -> None:
    decided, _ = follow(When((moment, then)), states)
    first, second = follow(moment, states)[0], follow(then, states)[0]
    step = first.index(True) if True in first else len(states)
    assert decided == [k >= step and second[step] for k in range(len(states))]


@given(FORMULAS, STATES, STATES)
def test_equal_memory_means_equal_future(formula: Formula, past: list[set[Atom]], future: list[set[Atom]]) -> None:
    """What decides later values is in `Evaluator.memory`: a copy and a replay with the same memory go on alike."""
    evaluator, other = Evaluator([formula]), Evaluator([formula])
    for state in past:
        evaluator.step(state.__contains__)
    for state in [*past, *past]:
        other.step(state.__contains__)
    again = copy.deepcopy(evaluator)
    assert again.memory == evaluator.memory
    hash(evaluator.memory)
    if other.memory == evaluator.memory:
        again = other
    assert [evaluator.step(s.__contains__) for s in future] == [again.step(s.__contains__) for s in future]


@given(FORMULAS, STATES)
def test_reset_forgets_everything(formula: Formula, states: list[set[Atom]]) -> None:
    evaluator = Evaluator([formula])
    fresh = evaluator.memory
    first = [evaluator.step(state.__contains__) for state in states]
    evaluator.reset()
    assert evaluator.memory == fresh
    assert evaluator.settled == (None,)
    assert [evaluator.step(state.__contains__) for state in states] == first
