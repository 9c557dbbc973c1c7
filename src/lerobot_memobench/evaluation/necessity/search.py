"""The best policy without memory when any order that the goal accepts will do, and a wrong answer may be mended.

`necessity` asks whether the demonstrated decisions can be repeated from pictures alone. A goal often accepts other
ways: three drawers may be opened together and closed one by one, and then each picture says what is left to do. Here
the answers are moves of a graph that was explored in the simulator (`decisions.explore`); a policy walks it from the
start, sees only pictures, and succeeds when the goal comes true within the horizon. Pure: no simulator.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.tasks.evaluator import Evaluator
from lerobot_memobench.tasks.formula import Atom, Formula

STRIDE = 25
"""Steps are counted in multiples of this when probabilities are optimised, rounded up: a move never gets cheaper."""
RESTARTS, ITERATIONS = 4, 200
VISITS = 300_000
"""Moves after which the search for the best map stops with the best it has found."""

Policy = dict[int, str]
"""Picture → answer."""


@dataclass(frozen=True)
class Move:
    """What an answer does at a node.

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
    """Explored part of a scene; node 0 is the start. A node without moves was not explored further.

    Attributes:
        pictures: class of what is seen, per node.
        moves: node → answer → move.
    """

    pictures: list[int]
    moves: dict[int, dict[str, Move]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Every node was explored."""
        return all(node in self.moves for node in range(len(self.pictures)))

    @property
    def answers(self) -> list[str]:
        """Every answer of some node, sorted."""
        return sorted({answer for moves in self.moves.values() for answer in moves})


class GoalWatch:
    """Follows one goal along moves; what it remembers is numbered, 0 at the start of the execution."""

    def __init__(self, goal: Formula) -> None:
        start = Evaluator([goal])
        self._evaluators = [start]
        self._numbers = {start.memory: 0}
        self._known: dict[tuple[int, int], tuple[int, int | None]] = {}

    def advance(self, memory: int, move: Move) -> tuple[int, int | None]:
        """Return the memory after a move, and at which of its steps the goal first held (from 1; None: never)."""
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
        number = self._numbers.setdefault(evaluator.memory, len(self._evaluators))
        if number == len(self._evaluators):
            self._evaluators.append(evaluator)
        return number, None


def best_map(graph: Graph, goals: Sequence[Formula], horizon: int) -> tuple[float, Policy]:
    """Return the largest share of equally likely goals that one map from pictures to answers reaches, and the map.

    The goals are variants of one scene: the same map walks the same way whatever the goal, so it is followed once and
    each goal is looked for along the way.
    """
    watches = [GoalWatch(goal) for goal in goals]
    answers = graph.answers
    best: tuple[float, Policy] = (0.0, {})
    visits = 0

    def walk(node: int, memories: tuple[int | None, ...], used: int, policy: Policy, seen: frozenset[object]) -> None:
        nonlocal best, visits
        reached = sum(memory is None for memory in memories)
        if reached / len(goals) > best[0]:
            best = (reached / len(goals), dict(policy))
        state = (node, memories)
        if best[0] == 1.0 or reached == len(goals) or state in seen or visits > VISITS:
            return
        picture = graph.pictures[node]
        chosen = [policy[picture]] if picture in policy else answers
        for answer in chosen:
            move = graph.moves.get(node, {}).get(answer)
            if move is None:
                continue
            visits += 1
            after = tuple(
                None if memory is None else _after(watch, memory, move, horizon - used)
                for watch, memory in zip(watches, memories, strict=True)
            )
            if used + move.steps < horizon:
                walk(move.to, after, used + move.steps, {**policy, picture: answer}, seen | {state})
                continue
            share = sum(memory is None for memory in after) / len(goals)  # the last move there was time for
            if share > best[0]:
                best = (share, {**policy, picture: answer})

    walk(0, (0,) * len(goals), 0, {}, frozenset())
    return best


def _after(watch: GoalWatch, memory: int, move: Move, left: int) -> int | None:
    """Return the memory after a move; None when the goal held in time."""
    number, step = watch.advance(memory, move)
    return None if step is not None and step <= left else number


# --- probabilities of answers ---

_State = tuple[int, int, int]
"""Node, memory, steps used / `STRIDE`."""
_SUCCESS, _FAILURE = -2, -1
"""Where an answer leads beside to other states; they are the last two places of an array over states."""


@dataclass
class _Walk:
    """All that can happen under one goal.

    Attributes:
        pictures: (S,) what is seen at each state, as a row of the policy.
        to: (S, A) where each answer leads: a state, `_SUCCESS` or `_FAILURE`.
        layers: runs of states that have used the same time, in its order: an answer leads to a later one.
    """

    pictures: NDArray[np.intp]
    to: NDArray[np.intp]
    layers: list[slice]


def best_probabilities(graph: Graph, goals: Sequence[Formula], horizon: int, seed: int = 0) -> float:
    """Return the success of the best probabilities of answers given the picture, over equally likely goals.

    Looked for by expectation maximisation over walks that succeed, from an even start, from the best map made a little
    uncertain, and from random ones: a bound that is reached, not one that is proven to be the largest.
    """
    value, policy = best_map(graph, goals, horizon)
    answers, pictures = graph.answers, sorted(set(graph.pictures))
    if not answers:
        return 0.0
    walks = [_unfold(graph, GoalWatch(goal), horizon, answers, pictures) for goal in goals]
    rng = np.random.default_rng(seed)
    even = np.full((len(pictures), len(answers)), 1.0 / len(answers))
    likely = 0.05 * even
    for row, picture in enumerate(pictures):
        likely[row, answers.index(policy.get(picture, answers[0]))] += 0.95
    starts = [even, likely, *(rng.dirichlet(np.ones(len(answers)), len(pictures)) for _ in range(RESTARTS))]
    return max(value, *(_climb(start, walks) for start in starts))


def _unfold(graph: Graph, watch: GoalWatch, horizon: int, answers: Sequence[str], pictures: Sequence[int]) -> _Walk:
    """Return every state that can be reached before the horizon and from which the goal can be."""
    layers: list[dict[_State, dict[str, _State | int]]] = [{} for _ in range(horizon // STRIDE + 1)]
    layers[0][0, 0, 0] = {}
    for layer in layers:
        for (node, memory, used), leads in layer.items():  # only later layers grow: a move takes a stride or more
            for answer, move in graph.moves.get(node, {}).items():
                after, step = watch.advance(memory, move)
                later = (move.to, after, used + max(1, -(-move.steps // STRIDE)))
                if step is not None:
                    leads[answer] = _SUCCESS if used * STRIDE + step <= horizon else _FAILURE
                elif later[2] < len(layers):
                    layers[later[2]].setdefault(later, {})
                    leads[answer] = later
    alive: set[_State] = {(0, 0, 0)}
    for layer in reversed(layers):
        alive |= {
            state for state, leads in layer.items() if any(to == _SUCCESS or to in alive for to in leads.values())
        }
    kept = [[state for state in layer if state in alive] for layer in layers]
    index = {state: k for k, state in enumerate(state for layer in kept for state in layer)}
    to = np.full((len(index), len(answers)), _FAILURE, dtype=np.intp)
    for layer in layers:
        for state, leads in layer.items():
            for answer, lead in leads.items() if state in index else ():
                place = lead if isinstance(lead, int) else index.get(lead, _FAILURE)
                to[index[state], answers.index(answer)] = place
    ends = np.cumsum([0, *(len(layer) for layer in kept)]).tolist()
    return _Walk(
        np.array([pictures.index(graph.pictures[node]) for node, _, _ in index], dtype=np.intp),
        to,
        [slice(begin, end) for begin, end in pairwise(ends) if end > begin],
    )


def _climb(policy: NDArray[np.float64], walks: Sequence[_Walk]) -> float:
    """Raise the success of ``policy`` (pictures, answers) until it stands still; return it."""
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
