"""Progress of an episode, and the choices of evidence episodes. No physics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lerobot_memobench.tasks.assessment import Choice, chance, handled_atoms, scene_and_variant
from lerobot_memobench.tasks.catalogue import get_task, load_task, task_names
from lerobot_memobench.tasks.formula import Atom, Then
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import SUITES, Task

FIRST, SECOND = Atom("on", ("butter_1", "bowl_1")), Atom("on", ("bowl_1", "plate_1"))
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"
SWAP = "swap_the_objects_strictly_following_the_3-step_buffered_sequence_shown_in_the_prompt"
MOVES = [Atom("on", args) for args in (("milk_1", "plate_mid"), ("butter_1", "plate_left"), ("milk_1", "plate_right"))]


def play(task: Task, *states: set[Atom]) -> Progress:
    progress = Progress(task)
    for state in states:
        progress.step(state.__contains__)
    return progress


def facts(progress: Progress) -> tuple[int, bool, int, tuple[bool, ...], list[int | None], list[int | None]]:
    return (
        progress.steps,
        progress.success,
        progress.index,
        progress.satisfied,
        [*progress.first_step],
        [*progress.ordered_step],
    )


def test_checkpoints_are_completed_in_order() -> None:
    progress = Progress(get_task(ASSEMBLY))
    assert facts(progress) == (0, False, 0, (False, False), [None, None], [None, None])
    for state in (set(), {FIRST}, {FIRST}, {FIRST, SECOND}):
        progress.step(state.__contains__)
    assert facts(progress) == (4, True, 2, (True, True), [2, 4], [2, 4])
    progress.step({FIRST}.__contains__)
    assert not progress.success, "success is the present value of the goal"


def test_two_evaluations_per_step_and_settling() -> None:
    """`Then` takes five steps per child with two evaluations; settling updates formulas but counts no step."""
    both = {FIRST, SECOND}.__contains__
    task = replace(get_task(ASSEMBLY), goal=Then((FIRST, SECOND)))
    assert [Progress(task, 2).step(both)] == [False]
    progress = Progress(task, evaluations=2)
    assert [progress.step(both) for _ in range(10)] == [False] * 9 + [True]
    settled = Progress(task, evaluations=2)
    for _ in range(7):
        settled.settle(both)
    assert (settled.steps, settled.first_step) == (0, [None, None])
    assert [settled.step(both) for _ in range(3)] == [False, False, True]
    assert (settled.steps, settled.first_step) == (3, [1, 1])
    nested = Progress(replace(task, goal=Then((Then((FIRST,)),))), evaluations=2)
    assert [nested.step(both) for _ in range(10)] == [False] * 9 + [True]  # evaluations 10 to 19


def test_task_without_checkpoints(write_task: Callable[..., Path], bddl: str) -> None:
    task = replace(load_task(write_task(bddl)), checkpoints=())
    progress = play(task, set(), {Atom("in", ("cup_1", "box_1_top_region"))})
    assert (progress.success, progress.satisfied) == (True, ())


@given(st.lists(st.sets(st.sampled_from([0, 1, 2])), max_size=40))
def test_order_properties(states: list[set[int]]) -> None:
    progress = play(get_task(SWAP), *({MOVES[i] for i in state} for state in states))
    firsts = [next((i + 1 for i, state in enumerate(states) if k in state), None) for k in range(3)]
    assert progress.first_step == firsts
    done = progress.ordered_step[: progress.index]
    assert progress.ordered_step[progress.index :] == [None] * (3 - progress.index)
    earlier = 1
    for k, ordered in enumerate(done):
        assert ordered == next(step for step in range(earlier, len(states) + 1) if k in states[step - 1])
        earlier = ordered


# --- choices and chance levels ---

BOWL = "put_the_butter_only_into_the_bowl_from_the_prompt_video"
PUBLISHED_MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
TOMATO = "find_the_tomato_hidden_in_one_of_the_drawers"
TWO = "find_the_tomato_or_the_biscuit_hidden_in_two_of_the_drawers"
STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
STACK = "stack_the_bowls_strictly_in_the_sequence_shown_in_the_prompt_video"


def on(thing: str, place: str) -> Atom:
    return Atom("on", (thing, place))


def drawer(name: str) -> Atom:
    return Atom("ajar", (f"wooden_cabinet_1_{name}_region",))


def lifted(thing: str) -> Atom:
    return Atom("lifted", (thing,))


def chosen(name: str, variant: int, *steps: set[Atom]) -> int | None:
    choice = Choice(get_task(name).variant(variant))
    for true in steps:
        choice.step(lambda atom, true=true: atom in true)
    return choice.variant


def test_each_scene_goes_through_all_variants_that_may_be_drawn() -> None:
    assert [scene_and_variant(get_task(BOWL), k) for k in range(5)] == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1)]
    assert [scene_and_variant(get_task(ASSEMBLY), k) for k in range(3)] == [(0, 1), (0, 2), (1, 1)]


def test_chance_is_that_of_the_best_answer_without_the_past() -> None:
    assert chance(get_task(PUBLISHED_MILK)) == 1 / 2
    assert chance(get_task(TOMATO)) == 1 / 3
    assert chance(get_task(TWO)) == 1 / 3, "the place of the other object is irrelevant"
    assert chance(get_task(STOVE)) is None, "the instruction contains the count"
    tasks = [get_task(name) for suite in SUITES for name in task_names(suite=suite)]
    rates = [rate for task in tasks if task.num_variants > 1 and (rate := chance(task)) is not None]
    assert len(rates) == 30
    assert all(0.1 < rate <= 0.5 for rate in rates)


@pytest.mark.parametrize("variant", [0, 1, 2])
def test_the_first_action_decides_whatever_is_requested(variant: int) -> None:
    middle = on("butter_1", "bowl_mid")
    assert chosen(BOWL, variant, set(), {middle}) == 1
    assert chosen(BOWL, variant, set()) is None


def test_an_opened_drawer_is_a_choice() -> None:
    assert chosen(TOMATO, 0, {drawer("middle")}) == 1
    assert chosen(TOMATO, 1, {drawer("middle")}) == 1, "the right one, and the hand failed"
    assert chosen(TOMATO, 0, {drawer("middle")}, {drawer("top")}) == 1, "a second one does not correct the first"


def test_an_answer_may_be_none_of_the_variants() -> None:
    order = [lifted(atom.args[0]) for atom in handled_atoms(get_task(STACK).variant(0))]
    choice = Choice(get_task(STACK).variant(0))
    assert not choice.answered
    for atom in (order[1], order[1], order[0]):
        choice.step(lambda other, atom=atom: other == atom)
    assert choice.answered
