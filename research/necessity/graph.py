"""An explored scene as a graph of states and answers, and the best policies without memory on it. Pure: no simulator.

`memoryless` asks whether the demonstrated decisions can be repeated from pictures alone. A goal often accepts other
ways: three drawers may be opened together and closed one by one, and then each picture shows the rest. Here the
answers are moves of a graph that was explored in the simulator; a policy walks it from the start, sees only
pictures, and succeeds when the goal comes true within the horizon.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.tasks.formula import Atom, Formula
from lerobot_memobench.tasks.progress import Evaluator


@dataclass(frozen=True)
class Move:
    """Effect of an answer at a node.

    Attributes:
        to: node it leads to.
        steps: control steps it takes.
        trace: (atoms that held, for how many steps), from its first step to its last.
    """

    to: int
    steps: int
    trace: tuple[tuple[frozenset[Atom], int], ...]


@dataclass
class Graph:
    """Explored part of a scene; node 0 is a start. A node without moves was not explored further.

    Attributes:
        pictures: class of the images, per node.
        moves: node → answer → move.
        decided: nodes that need no exploration: every goal is reached or lost there.
    """

    pictures: list[int]
    moves: dict[int, dict[str, Move]] = field(default_factory=dict)
    decided: set[int] = field(default_factory=set)

    @property
    def unexplored(self) -> list[int]:
        """Nodes that a goal may need and that were not explored."""
        return [node for node in range(len(self.pictures)) if node not in self.moves and node not in self.decided]

    @property
    def complete(self) -> bool:
        """Every node was explored that a goal needs."""
        return not self.unexplored

    @property
    def answers(self) -> list[str]:
        """Every answer of some node, sorted."""
        return sorted({answer for moves in self.moves.values() for answer in moves})


LOST = -1
"""State of a goal that can no longer be reached."""


class GoalWatch:
    """Follows one goal along moves; its states are numbered, 0 at the start of the execution, or `LOST`."""

    def __init__(self, goal: Formula) -> None:
        start = Evaluator([goal])
        self._evaluators = [start]
        self._numbers = {start.memory: 0}
        self._known: dict[tuple[int, int], tuple[int, int | None]] = {}

    def advance(self, memory: int, move: Move) -> tuple[int, int | None]:
        """Return the memory after a move, and at which of its steps the goal first held (from 1; None: never)."""
        if memory == LOST:
            return LOST, None
        key = (memory, id(move))
        if key not in self._known:
            self._known[key] = self._follow(memory, move)
        return self._known[key]

    def _follow(self, memory: int, move: Move) -> tuple[int, int | None]:
        evaluator = copy.deepcopy(self._evaluators[memory])
        step = 0
        for true, times in move.trace:
            for _ in range(times):
                step += 1
                if evaluator.step(true.__contains__)[0]:
                    return memory, step
        if evaluator.settled[0] is False:
            return LOST, None
        number = self._numbers.setdefault(evaluator.memory, len(self._evaluators))
        if number == len(self._evaluators):
            self._evaluators.append(evaluator)
        return number, None


Memories = tuple[int | None, ...]
"""State of each goal; None once it held in time."""


def advance_all(watches: Sequence[GoalWatch], memories: Memories, move: Move, left: int | None = None) -> Memories:
    """Return what goals remember after a move for which so many steps were left; None: as many as it takes."""
    found: list[int | None] = []
    for watch, memory in zip(watches, memories, strict=True):
        number, step = (None, None) if memory is None else watch.advance(memory, move)
        found.append(None if step is not None and (left is None or step <= left) else number)
    return tuple(found)


def is_decided(memories: Memories) -> bool:
    """Whether every goal is reached or lost."""
    return all(memory is None or memory == LOST for memory in memories)


# --- the best fixed map from pictures to answers ---

VISITS = 300_000
"""Moves after which the search for the best map stops with the best it has found."""

Policy = dict[int, str]
"""Picture → answer."""


def best_map(graph: Graph, goals: Sequence[Formula], horizon: int, starts: Sequence[int] = ()) -> tuple[float, Policy]:
    """Return the largest share of equally likely goals that one map from pictures to answers reaches, and the map.

    From one start a map acts alike for all goals, so it is followed once and each goal is looked
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
        node, memories, used: place, states of the goals of this start, steps used.
        visited: states on the way, to which a map returns for ever.
    """

    party: int
    reached: int
    node: int
    memories: Memories
    used: int = 0
    visited: frozenset[object] = frozenset()

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
        if is_decided(way.memories) or state in way.visited or self._visits > VISITS or not known:
            self.set_out(way.party + 1, way.total, policy)
            return
        for answer in known:
            self._visits += 1
            self._go_on(way, moves[answer], {**policy, picture: answer})

    def _go_on(self, way: _Way, move: Move, policy: Policy) -> None:
        """Take a move, the last one if there is time for no other."""
        watches = self._parties[way.party][1]
        memories = advance_all(watches, way.memories, move, self._horizon - way.used)
        visited = way.visited | {(way.node, way.memories)}
        after = _Way(way.party, way.reached, move.to, memories, way.used + move.steps, visited)
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


# --- the best probabilities of answers given the picture, where a wrong answer may be corrected ---

STRIDE = 25
"""Steps are counted in multiples of this when probabilities are optimised, rounded up: a move never gets cheaper."""
RESTARTS, ITERATIONS = 4, 200

_State = tuple[int, int, int]
"""Node, memory, steps used / `STRIDE`."""
_SUCCESS, _FAILURE = -2, -1
"""Ends of an answer other than states; the last two places of an array over states."""


_Layers = list[dict[_State, dict[str, _State | int]]]
"""By time used: state -> answer -> where it leads, a state, `_SUCCESS` or `_FAILURE`."""


@dataclass
class _Walk:
    """All that can happen under one goal.

    Attributes:
        pictures: (S,) class of the images at each state, as a row of the policy.
        to: (S, A) where each answer leads: a state, `_SUCCESS` or `_FAILURE`.
        layers: runs of states that have used the same time, in its order: an answer leads to a later one.
    """

    pictures: NDArray[np.intp]
    to: NDArray[np.intp]
    layers: list[slice]


def best_probabilities(graph: Graph, goals: Sequence[Formula], horizon: int, starts: Sequence[int] = ()) -> float:
    """Return the success of the best probabilities of answers given the picture, over equally likely goals.

    Looked for by expectation maximisation over walks that succeed, from an even start, from the best map made a little
    uncertain, and from random ones: a bound that is reached, not one that is proven to be the largest.

    Args:
        starts: as of `best_map`.
    """
    starts = starts or (0,) * len(goals)
    value, policy = best_map(graph, goals, horizon, starts)
    answers, pictures = graph.answers, sorted(set(graph.pictures))
    if not answers:
        return 0.0
    walks = [
        _unfold(graph, _reachable(graph, GoalWatch(goal), horizon, start), answers, pictures)
        for goal, start in zip(goals, starts, strict=True)
    ]
    rng = np.random.default_rng(0)
    even = np.full((len(pictures), len(answers)), 1.0 / len(answers))
    likely = 0.05 * even
    for row, picture in enumerate(pictures):
        likely[row, answers.index(policy.get(picture, answers[0]))] += 0.95
    tried = [even, likely, *(rng.dirichlet(np.ones(len(answers)), len(pictures)) for _ in range(RESTARTS))]
    return max(value, *(_climb(begin, walks) for begin in tried))


def _unfold(graph: Graph, layers: _Layers, answers: Sequence[str], pictures: Sequence[int]) -> _Walk:
    """Return every state that can be reached before the horizon and from which the goal can be."""
    alive = _hopeful(layers)
    index = {state: k for k, state in enumerate(state for layer in layers for state in layer if state in alive)}
    to = np.full((len(index), len(answers)), _FAILURE, dtype=np.intp)
    for layer in layers:
        for state, leads in layer.items():
            for answer, lead in leads.items() if state in index else ():
                place = lead if isinstance(lead, int) else index.get(lead, _FAILURE)
                to[index[state], answers.index(answer)] = place
    ends = np.cumsum([0, *(len(layer.keys() & alive) for layer in layers)]).tolist()
    return _Walk(
        np.array([pictures.index(graph.pictures[node]) for node, _, _ in index], dtype=np.intp),
        to,
        [slice(begin, end) for begin, end in pairwise(ends) if end > begin],
    )


def _reachable(graph: Graph, watch: GoalWatch, horizon: int, start: int) -> _Layers:
    layers: _Layers = [{} for _ in range(horizon // STRIDE + 1)]
    layers[0][start, 0, 0] = {}
    for layer in layers:
        for (node, memory, used), leads in layer.items():  # only later layers grow: a move takes a stride or more
            for answer, move in graph.moves.get(node, {}).items():
                after, step = watch.advance(memory, move)
                later = (move.to, after, used + max(1, -(-move.steps // STRIDE)))
                if step is not None:
                    leads[answer] = _SUCCESS if used * STRIDE + step <= horizon else _FAILURE
                elif after == LOST:
                    leads[answer] = _FAILURE
                elif later[2] < len(layers):
                    layers[later[2]].setdefault(later, {})
                    leads[answer] = later
    return layers


def _hopeful(layers: _Layers) -> set[_State]:
    """Return the start and the states from which the goal can be reached."""
    alive = set(layers[0])
    for layer in reversed(layers):
        alive |= {
            state for state, leads in layer.items() if any(to == _SUCCESS or to in alive for to in leads.values())
        }
    return alive


def _climb(policy: NDArray[np.float64], walks: Sequence[_Walk]) -> float:
    """Raise the success of ``policy`` (pictures, answers) until it no longer changes; return it."""
    value = 0.0
    for _ in range(ITERATIONS):
        expected = [_expect(policy, walk) for walk in walks]
        before, value = value, sum(success for success, _ in expected) / len(walks)
        if value - before < 1e-9:
            break
        used = np.sum([counts for _, counts in expected], axis=0)
        weight = used.sum(axis=1, keepdims=True)
        policy = np.where(weight > 0, used / np.maximum(weight, 1e-300), policy)
    return value


def _expect(policy: NDArray[np.float64], walk: _Walk) -> tuple[float, NDArray[np.float64]]:
    """Return the probability of success, and how often each answer is given in walks that succeed, (pictures, A)."""
    chosen = policy[walk.pictures]
    hope = np.zeros(len(walk.to) + 2)
    hope[_SUCCESS] = 1.0
    for layer in reversed(walk.layers):
        hope[layer] = (chosen[layer] * hope[walk.to[layer]]).sum(axis=1)
    reach = np.zeros(len(walk.to) + 2)
    reach[0] = 1.0
    for layer in walk.layers:
        np.add.at(reach, walk.to[layer], reach[layer, None] * chosen[layer])
    counts = np.zeros_like(policy)
    np.add.at(counts, walk.pictures, reach[:-2, None] * chosen * hope[walk.to])
    return float(hope[0]), counts
