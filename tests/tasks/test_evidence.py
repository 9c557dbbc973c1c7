"""Chosen variants and chance levels of evidence episodes."""

from __future__ import annotations

import pytest

from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.evidence import Choice, chance, handled_atoms, scene_and_variant
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import SUITES

BOWL = "put_the_butter_only_into_the_bowl_from_the_prompt_video"
PUBLISHED_MILK = "find_the_specific_milk_pointed_out_in_the_prompt_video_and_put_it_on_the_plate"
TOMATO = "find_the_tomato_hidden_in_one_of_the_drawers"
TWO = "find_the_tomato_or_the_biscuit_hidden_in_two_of_the_drawers"
STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
STACK = "stack_the_bowls_strictly_in_the_sequence_shown_in_the_prompt_video"
ASSEMBLY = "execute_the_assembly_procedure_demonstrated_in_the_prompt_video"


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


def test_a_second_answer_does_not_correct_the_first() -> None:
    fake, target = on("fake_milk_1", "plate_1"), on("target_milk", "plate_1")
    assert chosen(PUBLISHED_MILK, 0, {fake}, {fake, target}) == 1


def test_an_opened_drawer_is_a_choice() -> None:
    assert chosen(TOMATO, 0, {drawer("middle")}) == 1
    assert chosen(TOMATO, 1, {drawer("middle")}) == 1, "the right one, and the hand failed"
    assert chosen(TOMATO, 0, {drawer("middle")}, {drawer("top")}) == 1, "a second one does not correct the first"


@pytest.mark.parametrize("variant", [0, 1])
def test_a_lifted_object_is_a_choice(variant: int) -> None:
    assert chosen(PUBLISHED_MILK, variant, {lifted("fake_milk_1")}, {lifted("target_milk")}) == 1


def test_an_answer_may_be_none_of_the_variants() -> None:
    order = [lifted(atom.args[0]) for atom in handled_atoms(get_task(STACK).variant(0))]
    choice = Choice(get_task(STACK).variant(0))
    assert not choice.answered
    for atom in (order[1], order[1], order[0]):
        choice.step(lambda other, atom=atom: other == atom)
    assert choice.answered


def test_of_variants_with_the_same_goal_the_one_that_is_run_was_chosen() -> None:
    same = [k for k in range(12) if get_task(TWO).variant(k).goal == get_task(TWO).variant(0).goal]
    assert len(same) == 2
    for k in same:
        assert chosen(TWO, k, {drawer("top")}) == k
