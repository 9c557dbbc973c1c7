"""Logic and time of formulas, without physics: a table of states per step."""

from __future__ import annotations

import itertools
import random
from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.tasks.formula import (
    And,
    Atom,
    Formula,
    Not,
    Or,
    Then,
    parse_formula,
    to_lists,
)
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator

A, B, C = Atom("on", ("a", "p")), Atom("on", ("b", "p")), Atom("open", ("d",))


def run(formula: Formula, *states: set[Atom]) -> list[bool]:
    """Values of a formula over steps; a state is the set of atoms that hold."""
    evaluator = Evaluator([formula])
    return [evaluator.step(state.__contains__)[0] for state in states]


# --- parsing and printing ---


# --- logic ---


@pytest.mark.parametrize(("a", "b"), list(itertools.product([False, True], repeat=2)))
def test_truth_tables(a: bool, b: bool) -> None:
    state = {atom for atom, value in ((A, a), (B, b)) if value}
    assert run(And((A, B)), state) == [a and b]
    assert run(Or((A, B)), state) == [a or b]
    assert run(Not(A), state) == [not a]
    assert run(And((A, Not(Or((B, Not(A)))))), state) == [a and not b]


# --- latches ---


@pytest.mark.parametrize(("latch", "source"), [("wasopen", "open"), ("wasturnedon", "turnon")])
def test_latch_stays_from_the_first_step_until_reset(latch: str, source: str) -> None:
    evaluator = Evaluator([Atom(latch, ("d",))])
    now = {Atom(source, ("d",))}
    steps = [set(), now, set(), set()]
    assert [evaluator.step(state.__contains__)[0] for state in steps] == [False, True, True, True]
    evaluator.reset()
    assert evaluator.step(lambda atom: False) == (False,)


def test_latch_is_updated_though_nobody_asks() -> None:
    # The latch stands in the second child of Then, which is not looked at while the first is not done.
    was_open = Atom("wasopen", ("d",))
    states = [{C}] + [set()] * 3 + [{A}] * HOLD_STEPS + [set()] * HOLD_STEPS
    assert run(Then((A, was_open)), *states) == [False] * (len(states) - 1) + [True]


def test_latches_are_per_entity_and_shared_between_formulas() -> None:
    first, second = Atom("wasopen", ("d",)), Atom("wasopen", ("e",))
    evaluator = Evaluator([first, Not(first), second])
    assert evaluator.step({C}.__contains__) == (True, False, False)
    assert evaluator.latched == {first}


def test_world_is_never_asked_about_a_latch() -> None:
    asked: list[Atom] = []
    Evaluator([And((Atom("wasopen", ("d",)), Atom("wasturnedon", ("s",)), A))]).step(
        lambda atom: bool(asked.append(atom))
    )
    assert {atom.predicate for atom in asked} == {"open", "turnon", "on"}


# --- Then ---


def test_then_takes_ten_steps_per_child_and_stays() -> None:
    both = [{A, B}] * (2 * HOLD_STEPS)
    assert run(Then((A, B)), *both, set(), set()) == [False] * 19 + [True, True, True]
    assert run(Then((A,)), *[{A}] * 10, set()) == [False] * 9 + [True, True]


def test_then_hold_must_be_consecutive() -> None:
    states = [{A}] * 9 + [set()] + [{A}] * 10
    assert run(Then((A,)), *states) == [False] * 19 + [True]


def test_then_needs_the_order() -> None:
    assert not any(run(Then((A, B)), *[{B}] * 30, *[{A}] * 30))
    assert run(Then((A, B)), *[{B}] * 30, *[{A}] * 10, *[{B}] * 10)[-2:] == [False, True]


def test_then_does_not_look_ahead() -> None:
    asked: Counter[Atom] = Counter()
    evaluator = Evaluator([Then((A, B))])

    def holds(atom: Atom) -> bool:
        asked[atom] += 1
        return True

    for _ in range(HOLD_STEPS):
        evaluator.step(holds)
    assert asked == {A: HOLD_STEPS}
    for _ in range(HOLD_STEPS + 5):
        evaluator.step(holds)
    assert asked == {A: HOLD_STEPS, B: HOLD_STEPS}  # done stays done, unasked


def test_nested_then_is_a_child_like_any_other() -> None:
    # A: 10 steps, then the inner one: B 10, C 10, and itself true for 10 (from the step that completes it).
    formula = Then((A, Then((B, C))))
    assert run(formula, *[{A, B, C}] * 40).index(True) == 10 + 20 + 9 - 1
    # The inner one is not looked at before A is done, so early B and C do not count.
    assert not any(run(formula, *[{B}] * 10, *[{C}] * 10, *[{A}] * 10, *[{C}] * 20))


def test_then_inside_other_operators_sees_every_step() -> None:
    formula = Or((A, And((B, Then((C,))))))
    # While A alone decides the Or, the Then beside it still counts.
    states = [{A, C}] * 10 + [{B}]
    assert run(formula, *states) == [True] * 11
    assert run(Not(Then((A,))), *[{A}] * 11) == [True] * 9 + [False] * 2


def test_reset_forgets_then() -> None:
    evaluator = Evaluator([Then((A, B))])
    for _ in range(15):
        evaluator.step({A, B}.__contains__)
    evaluator.reset()
    assert [evaluator.step({A, B}.__contains__)[0] for _ in range(20)] == [False] * 19 + [True]


def test_one_question_per_atom_and_step() -> None:
    asked: Counter[Atom] = Counter()

    def holds(atom: Atom) -> bool:
        asked[atom] += 1
        return False

    was_open = Atom("wasopen", ("d",))
    Evaluator([And((A, Or((A, B)), was_open, C)), A, Not(B), was_open]).step(holds)
    assert asked == {A: 1, B: 1, C: 1}


# --- properties ---

_ATOMS = st.sampled_from(
    [
        A,
        B,
        C,
        Atom("wasopen", ("d",)),
        Atom("turnon", ("s",)),
        Atom("wasturnedon", ("s",)),
        Atom("in", ("a", "d")),
    ]
)
_WORLD = [A, B, C, Atom("turnon", ("s",)), Atom("in", ("a", "d"))]
FORMULAS = st.recursive(
    _ATOMS,
    lambda inner: st.one_of(
        inner.map(Not),
        *(
            st.lists(inner, min_size=1, max_size=3).map(lambda parts, kind=kind: kind(tuple(parts)))
            for kind in (And, Or, Then)
        ),
    ),
    max_leaves=8,
)
STATES = st.lists(st.sets(st.sampled_from(_WORLD)), min_size=1, max_size=60)


@given(FORMULAS)
def test_lists_roundtrip(formula: Formula) -> None:
    assert parse_formula(to_lists(formula)) == formula


@given(FORMULAS, STATES)
@settings(max_examples=60)
def test_evaluation_is_deterministic_and_shared_formulas_agree(formula: Formula, states: list[set[Atom]]) -> None:
    first = run(formula, *states)
    assert run(formula, *states) == first
    evaluator = Evaluator([formula, Not(formula), formula])
    for state, value in zip(states, first, strict=True):
        assert evaluator.step(state.__contains__) == (value, not value, value)


@given(STATES)
def test_latches_and_then_never_go_back(states: list[set[Atom]]) -> None:
    for formula in (Atom("wasopen", ("d",)), Then((A, B)), Then((Or((A, B)),)), Then((Then((A,)), B))):
        values = run(formula, *states)
        assert values == sorted(values)


@given(STATES, st.integers(0, 2**32 - 1))
def test_latch_equals_its_definition(states: list[set[Atom]], seed: int) -> None:
    random.Random(seed).shuffle(states)
    expected = list(itertools.accumulate((C in state for state in states), lambda x, y: x or y))
    assert run(Atom("wasopen", ("d",)), *states) == expected
