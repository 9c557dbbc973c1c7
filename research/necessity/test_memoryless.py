"""Chance and ceilings of policies without memory, from tables made by hand."""

from __future__ import annotations

import numpy as np
import pytest

from research.necessity.memoryless import (
    Decision,
    History,
    aliased,
    chance,
    classes,
    deterministic_ceiling,
    stochastic_ceiling,
)


def history(*decisions: tuple[int, str]) -> History:
    return tuple(Decision(picture, answer) for picture, answer in decisions)


def test_classes_join_pictures_through_a_chain_of_likeness() -> None:
    difference = np.array([[0.0, 0.1, 0.5, 0.9], [0.1, 0.0, 0.1, 0.9], [0.5, 0.1, 0.0, 0.9], [0.9, 0.9, 0.9, 0.0]])
    assert classes(difference, 0.1) == [0, 0, 0, 3]
    assert classes(difference, 0.0) == [0, 1, 2, 3]


def test_a_routine_whose_pictures_all_differ_needs_no_memory() -> None:
    stove = [history((0, "on"), (1, "off"))]
    assert aliased(stove) == {}
    assert (chance(stove), deterministic_ceiling(stove), stochastic_ceiling(stove)) == (1.0, 1.0, 1.0)


def test_one_picture_with_two_answers_in_an_episode_leaves_a_quarter() -> None:
    stove_and_pan = [history((0, "on"), (1, "off"), (0, "pan"))]
    assert aliased(stove_and_pan) == {0: ["on", "pan"]}
    assert chance(stove_and_pan) == 0.25
    assert deterministic_ceiling(stove_and_pan) == 0.0
    assert stochastic_ceiling(stove_and_pan) == pytest.approx(0.25)


def test_the_best_probabilities_follow_how_often_an_answer_is_needed() -> None:
    twice = [history((0, "a"), (0, "a"), (0, "b"))]
    assert chance(twice) == 0.125
    assert stochastic_ceiling(twice) == pytest.approx((2 / 3) ** 2 / 3)


def test_three_answers_at_one_picture() -> None:
    drawers = [history((0, "top"), (1, "shut"), (0, "middle"), (2, "shut"), (0, "bottom"), (3, "shut"))]
    assert chance(drawers) == pytest.approx(1 / 27)
    assert stochastic_ceiling(drawers) == pytest.approx(1 / 27)


@pytest.mark.parametrize("goals", [2, 3, 9])
def test_goals_behind_the_same_picture_leave_one_in_so_many(goals: int) -> None:
    histories = [history((0, f"take {k}"), (k + 1, "rest")) for k in range(goals)]
    assert chance(histories) == pytest.approx(1 / goals)
    assert deterministic_ceiling(histories) == pytest.approx(1 / goals)
    assert stochastic_ceiling(histories) == pytest.approx(1 / goals)


def test_a_fixed_map_serves_the_largest_set_of_goals_that_agree() -> None:
    histories = [history((0, "a"), (1, "x")), history((0, "a"), (2, "y")), history((0, "b"))]
    assert deterministic_ceiling(histories) == pytest.approx(2 / 3)
    assert chance(histories) == pytest.approx(0.5)
    assert stochastic_ceiling(histories) == pytest.approx(2 / 3)


def test_probabilities_may_beat_every_fixed_map() -> None:
    # No map passes either history, for each asks for both answers at picture 0.
    histories = [history((0, "a"), (0, "b")), history((0, "b"), (0, "a"))]
    assert deterministic_ceiling(histories) == 0.0
    assert stochastic_ceiling(histories) == pytest.approx(0.25)
