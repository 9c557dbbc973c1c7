"""The best fixed map from pictures to answers when any order that the goal accepts will do.

`aliasing` asks whether the demonstrated decisions can be repeated from pictures alone. A goal often accepts other
ways: three drawers may be opened together and closed one by one, and then each picture says what is left to do. Here
the answers are moves of a graph that was explored in the simulator; a policy walks it from the start, sees only
pictures, and succeeds when the goal comes true within the horizon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lerobot_memobench.evaluation.necessity.graph import LOST, GoalWatch, Graph, Memories, Move, advance_all, is_decided
from lerobot_memobench.tasks.formula import Formula

VISITS = 300_000
"""Moves after which the search for the best map stops with the best it has found."""

Policy = dict[int, str]
"""Picture → answer."""


def best_map(graph: Graph, goals: Sequence[Formula], horizon: int, starts: Sequence[int] = ()) -> tuple[float, Policy]:
    """Return the largest share of equally likely goals that one map from pictures to answers reaches, and the map.

    From one start the same map walks the same way whatever the goal, so it is followed once and each goal is looked
    for along the way.

    Args:
        starts: the node at which each goal's execution begins; empty: node 0 for all.
    """
    search = _Search(graph, goals, starts or (0,) * len(goals), horizon)
    search.set_out(0, 0, {})
    return search.best


@dataclass(frozen=True)
class _Way:
    """Where a map has led so far.

    Attributes:
        party: which start it began at. reached: goals reached from the starts before that one.
        node, memories, used: where it is, what the goals of this start remember, steps used.
        seen: states on the way, to which a map returns for ever.
    """

    party: int
    reached: int
    node: int
    memories: Memories
    used: int = 0
    seen: frozenset[object] = frozenset()

    @property
    def total(self) -> int:
        """Goals reached so far."""
        return self.reached + sum(memory is None for memory in self.memories)

    @property
    def open(self) -> int:
        """Goals of this start that may still be reached."""
        return sum(memory is not None and memory != LOST for memory in self.memories)


class _Search:
    """Tries maps depth first, choosing an answer for a picture when it is first met, start after start.

    Attributes:
        best: share of goals and map of the best found.
    """

    def __init__(self, graph: Graph, goals: Sequence[Formula], starts: Sequence[int], horizon: int) -> None:
        self._graph, self._horizon, self._answers = graph, horizon, graph.answers
        self._parties = [
            (start, [GoalWatch(goal) for goal, its_start in zip(goals, starts, strict=True) if its_start == start])
            for start in dict.fromkeys(starts)
        ]
        self._goals, self._visits = len(goals), 0
        self.best: tuple[float, Policy] = (0.0, {})

    def set_out(self, party: int, reached: int, policy: Policy) -> None:
        """Follow a map from the next start, or note how far it came from all."""
        if party == len(self._parties):
            self._note(reached, policy)
            return
        start, watches = self._parties[party]
        self._walk(_Way(party, reached, start, (0,) * len(watches)), policy)

    def _walk(self, way: _Way, policy: Policy) -> None:
        """Go on from a node."""
        if way.party == len(self._parties) - 1:
            self._note(way.total, policy)
        if self._cannot_win(way):
            return
        state = (way.node, way.memories)
        moves = self._graph.moves.get(way.node, {})
        picture = self._graph.pictures[way.node]
        answers = [policy[picture]] if picture in policy else self._answers
        known = [answer for answer in answers if answer in moves]
        if is_decided(way.memories) or state in way.seen or self._visits > VISITS or not known:
            self.set_out(way.party + 1, way.total, policy)
            return
        for answer in known:
            self._visits += 1
            self._go_on(way, moves[answer], {**policy, picture: answer})

    def _go_on(self, way: _Way, move: Move, policy: Policy) -> None:
        """Take a move, the last one if there is time for no other."""
        watches = self._parties[way.party][1]
        memories = advance_all(watches, way.memories, move, self._horizon - way.used)
        seen = way.seen | {(way.node, way.memories)}
        after = _Way(way.party, way.reached, move.to, memories, way.used + move.steps, seen)
        if after.used < self._horizon:
            self._walk(after, policy)
        else:
            self.set_out(way.party + 1, after.total, policy)

    def _cannot_win(self, way: _Way) -> bool:
        """Whether no map that begins like this reaches more goals than the best known."""
        later = sum(len(watches) for _, watches in self._parties[way.party + 1 :])
        return way.total + way.open + later <= round(self.best[0] * self._goals)

    def _note(self, reached: int, policy: Policy) -> None:
        share = reached / self._goals
        if share > self.best[0]:
            self.best = (share, policy)
