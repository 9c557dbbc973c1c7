"""The best map and the best probabilities in any order that the goal accepts, on graphs made by hand."""

from __future__ import annotations

import pytest

from lerobot_memobench.evaluation.necessity.best_map import best_map
from lerobot_memobench.evaluation.necessity.best_probabilities import best_probabilities
from lerobot_memobench.evaluation.necessity.graph import Graph, Move
from lerobot_memobench.tasks.formula import And, Atom, Formula, Not, Then

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
