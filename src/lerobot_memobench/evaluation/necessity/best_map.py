"""The best fixed map from pictures to answers when any order that the goal accepts will do.

`aliasing` asks whether the demonstrated decisions can be repeated from pictures alone. A goal often accepts other
ways: three drawers may be opened together and closed one by one, and then each picture says what is left to do. Here
the answers are moves of a graph that was explored in the simulator; a policy walks it from the start, sees only
pictures, and succeeds when the goal comes true within the horizon.
"""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.evaluation.necessity.graph import GoalWatch, Graph, Move
from lerobot_memobench.tasks.formula import Formula

VISITS = 300_000
"""Moves after which the search for the best map stops with the best it has found."""

Policy = dict[int, str]
"""Picture → answer."""

Memories = tuple[int | None, ...]
"""Per goal what it remembers, None once it held in time."""


def best_map(graph: Graph, goals: Sequence[Formula], horizon: int) -> tuple[float, Policy]:
    """Return the largest share of equally likely goals that one map from pictures to answers reaches, and the map.

    The goals are variants of one scene: the same map walks the same way whatever the goal, so it is followed once and
    each goal is looked for along the way.
    """
    search = _Search(graph, goals, horizon)
    search.walk(0, (0,) * len(goals), 0, {}, frozenset())
    return search.best


class _Search:
    """Tries maps depth first, choosing an answer for a picture when it is first met.

    Attributes:
        best: share of goals and map of the best found.
    """

    def __init__(self, graph: Graph, goals: Sequence[Formula], horizon: int) -> None:
        self._graph, self._horizon, self._answers = graph, horizon, graph.answers
        self._watches = [GoalWatch(goal) for goal in goals]
        self._visits = 0
        self.best: tuple[float, Policy] = (0.0, {})

    def walk(self, node: int, memories: Memories, used: int, policy: Policy, seen: frozenset[object]) -> None:
        """Go on from a node after ``used`` steps; ``seen`` are states on the way, to which a map returns for ever."""
        self._note(memories, policy)
        state = (node, memories)
        done = self.best[0] == 1.0 or all(memory is None for memory in memories)
        if done or state in seen or self._visits > VISITS:
            return
        picture = self._graph.pictures[node]
        for answer in [policy[picture]] if picture in policy else self._answers:
            move = self._graph.moves.get(node, {}).get(answer)
            if move is None:
                continue
            self._visits += 1
            after, chosen = self._after(memories, move, self._horizon - used), {**policy, picture: answer}
            if used + move.steps < self._horizon:
                self.walk(move.to, after, used + move.steps, chosen, seen | {state})
            else:  # the last move there was time for
                self._note(after, chosen)

    def _note(self, memories: Memories, policy: Policy) -> None:
        share = sum(memory is None for memory in memories) / len(memories)
        if share > self.best[0]:
            self.best = (share, policy)

    def _after(self, memories: Memories, move: Move, left: int) -> Memories:
        """Return what the goals remember after a move for which so many steps were left."""
        found: list[int | None] = []
        for watch, memory in zip(self._watches, memories, strict=True):
            number, step = (None, None) if memory is None else watch.advance(memory, move)
            found.append(None if step is not None and step <= left else number)
        return tuple(found)
