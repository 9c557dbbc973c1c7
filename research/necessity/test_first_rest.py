"""Why a rest decides before the first event too: else a policy without memory could wait there. No simulator."""

from __future__ import annotations

import pytest

from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import And, Atom, Exactly, Formula, Hold, Not, Round, When
from research.necessity.graph import Graph, Move, best_probabilities

HORIZON = 1200
STOVE = get_task("turn_the_stove_on_and_off_a_given_number_of_times")
ON, OFF, HOME = Atom("turnon", ("flat_stove_1",)), Atom("turnoff", ("flat_stove_1",)), Atom("handhome", ())
IN_PLACE = frozenset(Atom("inplace", (thing,)) for thing in STOVE.objects)


def graph() -> Graph:
    """One picture, the hand at home and the stove off: do it once more and come home, or wait a second."""
    away, lit, home = IN_PLACE | {OFF}, IN_PLACE | {ON}, IN_PLACE | {OFF, HOME}
    once = Move(0, 124, ((home, 1), (away, 40), (lit, 40), (away, 40), (home, 3)))
    return Graph([0], {0: {"once more": once, "wait": Move(0, 20, ((home, 20),))}})


@pytest.mark.parametrize(("variant", "best"), [(0, 1 / 4), (1, 4 / 27), (2, 27 / 256)])
def test_without_a_count_no_probability_does_better_than_chance(variant: int, best: float) -> None:
    found = best_probabilities(graph(), [STOVE.variant(variant).goal], HORIZON)
    assert 0.9 * best < found < best + 1e-6


def test_if_the_first_rest_did_not_count_waiting_would_do() -> None:
    goal = STOVE.variant(0).goal
    assert isinstance(goal, When)
    rest, counted = goal.children
    assert isinstance(rest, Hold)
    begun: Formula = Not(Exactly(0, Round((ON, OFF))))
    lenient = When((And((rest, begun)), counted))
    assert best_probabilities(graph(), [lenient], HORIZON) > 0.7
