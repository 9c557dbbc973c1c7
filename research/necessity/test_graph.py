"""The best map and the best probabilities in any order that the goal accepts, on graphs made by hand."""

from __future__ import annotations

import pytest

from lerobot_memobench.tasks.catalogue import get_task
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
    children,
)
from research.necessity.graph import LOST, GoalWatch, Graph, Move, best_map, best_probabilities

TOP, MIDDLE = Atom("open", ("top",)), Atom("open", ("middle",))
BOTH_SEEN = And(
    (
        Atom("wasopen", ("top",)),
        Atom("wasopen", ("middle",)),
        Atom("close", ("top",)),
        Atom("close", ("middle",)),
    )
)


def drawers(steps: int = 100) -> Graph:
    """Two drawers, each open or closed: node = top open + 2 · middle open; every state looks different."""
    moves: dict[int, dict[str, Move]] = {}
    for node in range(4):
        moves[node] = {}
        for name, bit in (("top", 1), ("middle", 2)):
            for word, to in (("open", node | bit), ("close", node & ~bit)):
                moves[node][f"{word} {name}"] = Move(to, steps, ((_true(node), steps - 1), (_true(to), 1)))
    return Graph([0, 1, 2, 3], moves)


def _true(node: int) -> frozenset[Atom]:
    return frozenset(Atom("open" if node & bit else "close", (name,)) for name, bit in (("top", 1), ("middle", 2)))


def test_drawers_that_look_the_same_again_can_be_seen_open_together() -> None:
    share, policy = best_map(drawers(), [BOTH_SEEN], horizon=400)
    assert share == 1.0
    # From closed to both open and back by another way: no picture is met twice.
    node, pictures = 0, []
    for _ in range(4):
        pictures.append(node)
        node = drawers().moves[node][policy[node]].to
    assert node == 0
    assert sorted(pictures) == [0, 1, 2, 3]


def test_the_horizon_cuts_off_what_takes_too_long() -> None:
    assert best_map(drawers(), [BOTH_SEEN], horizon=399)[0] == 0.0
    assert best_probabilities(drawers(), [BOTH_SEEN], horizon=375) == 0.0


def test_a_drawer_at_a_time_leaves_a_coin() -> None:
    """When only one drawer opens at a time, the closed cabinet asks for a coin, thrown as often as there is time."""
    graph = drawers()
    for node in (1, 2):
        for answer in ("open top", "open middle"):
            graph.moves[node][answer] = Move(node, 100, ((_true(node), 100),))
    assert best_map(graph, [BOTH_SEEN], horizon=400)[0] == 0.0
    assert best_probabilities(graph, [BOTH_SEEN], horizon=400) == pytest.approx(1 / 2, abs=1e-3)
    # 600 steps: a third throw mends a wrong second one.
    assert best_probabilities(graph, [BOTH_SEEN], horizon=600) == pytest.approx(3 / 4, abs=1e-3)


def choices(goals: int, mend: bool) -> tuple[Graph, list[Formula]]:
    """One of several things is put on a plate; taking it off again puts it back."""
    on = [Atom("on", (f"milk_{k}", "plate")) for k in range(goals)]
    moves: dict[int, dict[str, Move]] = {0: {}}
    for k in range(goals):
        moves[0][f"put {k}"] = Move(k + 1, 100, ((frozenset(), 80), (frozenset({on[k]}), 20)))
        moves[k + 1] = {"clear": Move(0, 100, ((frozenset(), 100),))} if mend else {}
    return Graph(list(range(goals + 1)), moves), list(on)


def test_a_wrong_choice_that_cannot_be_mended_leaves_one_in_so_many() -> None:
    graph, goals = choices(4, mend=False)
    assert best_map(graph, goals, horizon=1200)[0] == 0.25
    assert best_probabilities(graph, goals, horizon=1200) == pytest.approx(0.25, abs=1e-6)


def test_a_wrong_choice_that_can_be_mended_is_tried_again() -> None:
    graph, goals = choices(2, mend=True)
    assert best_map(graph, goals, horizon=500)[0] == 0.5
    assert best_probabilities(graph, goals, horizon=500) == pytest.approx(1 - 0.5**3, abs=1e-3)


def test_order_is_asked_for_by_then_and_needs_its_hold() -> None:
    first, second = Atom("on", ("a", "plate")), Atom("on", ("b", "plate"))
    goal = Then((first, second))
    moves = {
        0: {
            "a": Move(1, 50, ((frozenset(), 30), (frozenset({first}), 20))),
            "b": Move(2, 50, ((frozenset({second}), 50),)),
        },
        1: {"b": Move(3, 50, ((frozenset({first, second}), 50),))},
        2: {"a": Move(3, 50, ((frozenset({first, second}), 50),))},
        3: {},
    }
    share, policy = best_map(Graph([0, 1, 2, 3], moves), [goal], horizon=200)
    assert (share, policy[0], policy[1]) == (1.0, "a", "b")
    short = {**moves, 0: {"a": Move(1, 39, ((frozenset(), 30), (frozenset({first}), 9)))}, 1: {}}
    assert best_map(Graph([0, 1, 2, 3], short), [goal], horizon=200)[0] == 0.0


def test_what_must_not_be_ends_a_goal_for_good() -> None:
    wrong, right = Atom("on", ("b", "plate")), Atom("on", ("a", "plate"))
    goal = And((right, Not(wrong)))
    moves = {
        0: {"a": Move(1, 50, ((frozenset({right}), 50),)), "b": Move(2, 50, ((frozenset({wrong}), 50),))},
        2: {"a": Move(3, 50, ((frozenset({right, wrong}), 50),))},
    }
    graph = Graph([0, 1, 2, 3], moves)
    assert best_map(graph, [goal], horizon=500)[0] == 1.0
    assert not graph.complete
    del moves[0]["a"]
    assert best_map(graph, [goal], horizon=500)[0] == 0.0


def test_success_counts_at_the_step_it_comes_not_at_the_end_of_the_move() -> None:
    goal = Atom("on", ("a", "plate"))
    graph = Graph([0, 1], {0: {"a": Move(1, 300, ((frozenset(), 99), (frozenset({goal}), 201)))}})
    assert best_map(graph, [goal], horizon=100)[0] == 1.0
    assert best_map(graph, [goal], horizon=99)[0] == 0.0
    assert best_probabilities(graph, [goal], horizon=100) == 1.0


# --- the strict suite: rests, losses, several starts ---

HOME = Atom("handhome", ())
OPEN, SHUT = Atom("open", ("door",)), Atom("close", ("door",))


def door() -> Graph:
    """A door that is opened and shut, and rests: node 0 shut, node 1 open; the pictures do not show how often."""
    rest = {node: Move(node, 52, ((frozenset({HOME, (SHUT, OPEN)[node]}), 52),)) for node in (0, 1)}
    leaving = (frozenset({HOME, SHUT}), 2)
    opened = Move(1, 100, (leaving, (frozenset({SHUT}), 78), (frozenset({OPEN}), 8), (frozenset({HOME, OPEN}), 12)))
    shut = Move(0, 100, ((frozenset({OPEN}), 80), (frozenset({SHUT}), 8), (frozenset({HOME, SHUT}), 12)))
    return Graph([0, 1], {0: {"open": opened, "rest": rest[0]}, 1: {"shut": shut, "rest": rest[1]}})


def times(number: int) -> Formula:
    """Open and shut the door so often, then rest: the first rest decides."""
    return When((Hold(40, And((HOME, SHUT))), Exactly(number, Round((HOME, OPEN, SHUT)))))


@pytest.mark.parametrize(("number", "best"), [(1, 1 / 4), (2, 4 / 27), (3, 27 / 256)])
def test_who_does_not_count_stops_by_chance(number: int, best: float) -> None:
    """At the shut door the best probabilities go on as often as they must, and stop once: p to the n times 1 - p."""
    assert best_map(door(), [times(number)], horizon=1200) == (0.0, {})
    assert best_probabilities(door(), [times(number)], horizon=1200) == pytest.approx(best, abs=1e-3)


def test_who_may_rest_before_the_first_event_and_knows_it_gains_nothing() -> None:
    """A rest at the start is lost at once and marked, so later states need no exploration."""
    watch = GoalWatch(times(1))
    moves = door().moves
    assert watch.advance(0, moves[0]["rest"]) == (LOST, None)
    assert watch.advance(LOST, moves[0]["open"]) == (LOST, None)
    once = watch.advance(watch.advance(0, moves[0]["open"])[0], moves[1]["shut"])[0]
    assert watch.advance(once, moves[0]["rest"]) == (once, 28), "twelve steps at home were part of the rest"


def hidden() -> tuple[Graph, list[Formula], list[int]]:
    """A thing in one of three drawers: three starts that look the same, and a wrong drawer ends it."""
    moves: dict[int, dict[str, Move]] = {}
    pictures = [0, 0, 0]
    for place in range(3):
        moves[place] = {}
        for drawer in range(3):
            opened = frozenset({Atom("open", (f"drawer_{drawer}",))})
            moves[place][f"open {drawer}"] = Move(len(pictures), 100, ((opened, 100),))
            if drawer == place:
                on_table = frozenset({*opened, Atom("on", ("thing", "table"))})
                moves[len(pictures)] = {"take": Move(len(pictures), 100, ((on_table, 100),))}
            pictures.append(1 + drawer if drawer == place else 10 + drawer)
    goals: list[Formula] = [
        And(
            (
                Never(Or(tuple(Atom("open", (f"drawer_{k}",)) for k in range(3) if k != place))),
                Atom("on", ("thing", "table")),
            )
        )
        for place in range(3)
    ]
    return Graph(pictures, moves), goals, [0, 1, 2]


def test_what_was_hidden_is_found_by_one_map_from_one_start_in_three() -> None:
    graph, goals, starts = hidden()
    share, policy = best_map(graph, goals, 1200, starts)
    assert share == pytest.approx(1 / 3)
    assert policy[0].startswith("open")
    assert best_probabilities(graph, goals, 1200, starts) == pytest.approx(1 / 3, abs=1e-6)


def test_starts_that_look_different_are_each_answered() -> None:
    graph, goals, starts = hidden()
    graph.pictures[1], graph.pictures[2] = 20, 21
    assert best_map(graph, goals, 1200, starts)[0] == 1.0
    assert best_probabilities(graph, goals, 1200, starts) == 1.0


# --- why a rest decides before the first event too: else a policy without memory could wait there ---

HORIZON = 1200
STOVE = get_task("turn_the_stove_on_and_off_a_given_number_of_times")
ON, OFF = Atom("turnon", ("flat_stove_1",)), Atom("turnoff", ("flat_stove_1",))
AS_BEGUN = Atom("asbegun", ())
IN_PLACE = frozenset(Atom("inplace", (thing,)) for thing in STOVE.objects)


def stove() -> Graph:
    """One picture, the hand at home and the stove off: do it once more and come home, or wait a second."""
    away, lit, home = IN_PLACE | {OFF}, IN_PLACE | {ON}, IN_PLACE | {OFF, HOME, AS_BEGUN}
    once = Move(0, 124, ((home, 1), (away, 40), (lit, 40), (away, 40), (home, 3)))
    return Graph([0], {0: {"once more": once, "wait": Move(0, 20, ((home, 20),))}})


@pytest.mark.parametrize(("variant", "best"), [(0, 1 / 4), (1, 4 / 27), (2, 27 / 256)])
def test_without_a_count_no_probability_does_better_than_chance(variant: int, best: float) -> None:
    found = best_probabilities(stove(), [STOVE.variant(variant).goal], HORIZON)
    assert 0.9 * best < found < best + 1e-6


def test_if_the_first_rest_did_not_count_waiting_would_do() -> None:
    (goal,) = [part for part in children(STOVE.variant(0).goal) if isinstance(part, When)]
    rest, counted = goal.children
    assert isinstance(rest, Hold)
    begun: Formula = Not(Exactly(0, Round((ON, OFF))))
    lenient = When((And((rest, begun)), counted))
    assert best_probabilities(stove(), [lenient], HORIZON) > 0.7
