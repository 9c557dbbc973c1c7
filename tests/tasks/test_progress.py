"""Checkpoints over an episode: when, and in which order; logic and time of formulas, without physics."""

from __future__ import annotations

import itertools
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_memobench.tasks.catalogue import get_task
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
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator, Progress
from lerobot_memobench.tasks.task import Task

FIRST, SECOND = Atom("on", ("butter_1", "bowl_1")), Atom("on", ("bowl_1", "plate_1"))
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"


def play(task: Task, *states: set[Atom]) -> Progress:
    progress = Progress(task)
    for state in states:
        progress.step(state.__contains__)
    return progress


def test_before_the_first_step() -> None:
    progress = Progress(get_task(ASSEMBLY))
    assert (progress.steps, progress.success, progress.index) == (0, False, 0)
    assert progress.satisfied == (False, False)
    assert progress.first_step == progress.ordered_step == [None, None]


def test_in_order() -> None:
    progress = play(get_task(ASSEMBLY), set(), {FIRST}, {FIRST}, {FIRST, SECOND})
    assert progress.first_step == progress.ordered_step == [2, 4]
    assert (progress.steps, progress.success, progress.index, progress.satisfied) == (
        4,
        True,
        2,
        (True, True),
    )


def test_out_of_order_counts_from_the_step_at_which_the_earlier_are_complete() -> None:
    early = play(get_task(ASSEMBLY), {SECOND}, {FIRST}, set())
    assert early.first_step == [2, 1]
    assert early.ordered_step == [2, None]
    assert early.index == 1
    held = play(get_task(ASSEMBLY), {SECOND}, {FIRST, SECOND})
    assert held.ordered_step == [2, 2]  # both complete in one step
    later = play(get_task(ASSEMBLY), {SECOND}, {FIRST}, {SECOND})
    assert later.ordered_step == [2, 3]
    assert not later.success


def test_success_is_the_goal_now() -> None:
    progress = Progress(get_task(ASSEMBLY))
    assert progress.step({FIRST, SECOND}.__contains__) is True
    assert progress.step({FIRST}.__contains__) is False
    assert progress.success is False
    assert progress.ordered_step == [1, 1]


def test_latched_checkpoint() -> None:
    on, off = Atom("turnon", ("flat_stove_1",)), Atom("turnoff", ("flat_stove_1",))
    progress = play(get_task("turn_on_the_stove_and_turn_it_off"), {off}, {on}, set(), {off})
    assert progress.first_step == progress.ordered_step == [2, 4]
    assert progress.satisfied == (True, True)
    assert progress.success


def test_then_goal_of_the_swap() -> None:
    one, two, three = (
        Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))
    )
    progress = play(get_task(SWAP), *[{one}] * 10, *[{one, two}] * 10, *[{two, three}] * 18)
    assert progress.ordered_step == [1, 11, 21]
    assert not progress.success
    assert progress.step({two, three}.__contains__)  # inner Then done at step 30, held ten steps at step 39
    assert not play(get_task(SWAP), *[{one, two, three}] * 9).success


def test_reset() -> None:
    progress = play(get_task(ASSEMBLY), {FIRST, SECOND})
    progress.reset()
    assert (progress.steps, progress.success, progress.index, progress.first_step) == (
        0,
        False,
        0,
        [None, None],
    )


def test_task_without_checkpoints(write_task: Callable[..., Path], bddl: str) -> None:
    from lerobot_memobench.tasks.catalogue import load_task

    task = load_task(write_task(bddl, None), require_metadata=False)
    progress = play(task, set(), {Atom("in", ("cup_1", "box_1_top_region"))})
    assert progress.success
    assert progress.satisfied == ()


@given(st.lists(st.sets(st.sampled_from([0, 1, 2])), max_size=40))
def test_order_properties(states: list[Any]) -> None:
    task = get_task(SWAP)
    parts = [
        Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))
    ]
    progress = play(task, *({parts[i] for i in state} for state in states))
    done = [step for step in progress.ordered_step if step is not None]
    assert done == sorted(done)
    assert len(done) == progress.index
    assert progress.ordered_step[progress.index :] == [None] * (3 - progress.index)
    for k, ordered in enumerate(progress.ordered_step):
        first = progress.first_step[k]
        expected = next((i + 1 for i, state in enumerate(states) if k in state), None)
        assert first == expected
        if ordered is not None:
            assert first is not None
            assert ordered >= first
            assert k in states[ordered - 1]
            assert all(step is not None and step <= ordered for step in progress.first_step[:k])


# --- formulas: a table of states per step ---

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


def test_then_takes_five_steps_where_they_are_evaluated_twice() -> None:
    """And runs while the scene settles, where latches are set too; of that no step is counted."""
    butter_then_plate = replace(get_task(ASSEMBLY), goal=Then((FIRST, SECOND)))
    both = {FIRST, SECOND}.__contains__
    progress = Progress(butter_then_plate, evaluations=2)
    assert [progress.step(both) for _ in range(10)] == [False] * 9 + [True]
    settled = Progress(butter_then_plate, evaluations=2)
    for _ in range(7):
        settled.settle(both)
    assert (settled.steps, settled.first_step) == (0, [None, None])
    assert [settled.step(both) for _ in range(3)] == [False, False, True]
    assert (settled.steps, settled.first_step) == (3, [1, 1])


def test_a_part_of_a_nested_then_begins_within_a_step_where_it_is_evaluated_twice() -> None:
    """The inner one is true from evaluation 10 on, the outer counts from there: it is done with evaluation 19."""
    progress = Progress(replace(get_task(ASSEMBLY), goal=Then((Then((FIRST,)),))), evaluations=2)
    assert [progress.step({FIRST}.__contains__) for _ in range(10)] == [False] * 9 + [True]


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
