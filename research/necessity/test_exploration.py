"""What can be tried, and from where: the answers of an expert, and the arm brought home."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import Atom
from research.necessity.demonstrations import Home, difference, largest_pixel_difference, photograph, rest_steps
from research.necessity.exploration import answers_of
from research.necessity.scene import PIXEL_EXACT
from research.necessity.settings import variants_of

PAN = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"
STACK = "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"


def test_answers_are_what_the_expert_does_in_some_variant() -> None:
    assert answers_of([get_task(PAN)]) == [
        Atom("turnon", ("flat_stove_1",)),
        Atom("turnoff", ("flat_stove_1",)),
        Atom("on", ("chefmate_8_frypan_1", "flat_stove_1_cook_region")),
    ]
    stacks = answers_of(variants_of(get_task(STACK), "random"))
    assert len(stacks) == 6
    assert {atom.predicate for atom in stacks} == {"on"}


def test_where_the_hand_stands_is_no_answer_and_rest_is_as_long_as_the_goal_says() -> None:
    strict_task = get_task("turn_the_stove_on_and_off_a_given_number_of_times")
    assert {atom.predicate for atom in answers_of(variants_of(strict_task, "drawn"))} == {"turnon", "turnoff"}
    assert rest_steps(strict_task.goal) == 40
    assert rest_steps(get_task(PAN).goal) == 0


# --- the arm is brought home and the world stays as it is ---

PAN = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"


def test_the_arm_comes_home_and_the_simulation_goes_on_as_if_it_had_not(gl: None) -> None:
    task = get_task(PAN)
    runs = []
    for look in (False, True):
        sim = Simulation(task)
        sim.reset(7)
        home = Home(sim)
        at_start = photograph(sim)
        for _ in range(6):
            sim.step(np.array([0.5, 0.5, 0.3, 0.0, 0.0, 0.2, 1.0]))
        if look:
            assert difference(photograph(sim), at_start) > 0.01, "the arm has moved"
            assert largest_pixel_difference(home.look(), at_start) <= PIXEL_EXACT
        for _ in range(3):
            sim.step(NO_OP)
        runs.append(sim.state())
    np.testing.assert_array_equal(*runs)
