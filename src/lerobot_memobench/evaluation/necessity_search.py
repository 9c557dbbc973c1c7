"""The best policy without memory when any order that the goal accepts will do, and a wrong answer may be mended.

`necessity` asks whether the demonstrated decisions can be repeated from pictures alone. A goal often accepts other
ways: three drawers may be opened together and closed one by one, and then each picture says what is left to do. Here
the answers are moves of a graph that was explored in the simulator (`decisions.explore`); a policy walks it from the
start, sees only pictures, and succeeds when the goal comes true within the horizon. Pure: no simulator.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lerobot_memobench.tasks.formula import Atom, Evaluator, Formula

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


@dataclass
class _Walk:
    """All that can happen under one goal: states in the order of steps used, and where each answer leads."""

    states: list[_State]
    ways: list[dict[str, int]]
    """Per state: answer → index of the next state, `_SUCCESS` or `_FAILURE`."""


_SUCCESS, _FAILURE = -1, -2


def best_probabilities(graph: Graph, goals: Sequence[Formula], horizon: int, seed: int = 0) -> float:
    """Return the success of the best probabilities of answers given the picture, over equally likely goals.

    Looked for by expectation maximisation over walks that succeed, from an even start, from the best map made a little
    uncertain, and from random ones: a bound that is reached, not one that is proven to be the largest.
    """
    walks = [_unfold(graph, GoalWatch(goal), horizon) for goal in goals]
    value, policy = best_map(graph, goals, horizon)
    answers, pictures = graph.answers, sorted(set(graph.pictures))
    if not answers:
        return 0.0
    rng = np.random.default_rng(seed)
    place = {picture: row for row, picture in enumerate(pictures)}
    column = {answer: k for k, answer in enumerate(answers)}
    even = np.full((len(pictures), len(answers)), 1.0 / len(answers))
    likely = 0.05 * even
    for picture in pictures:
        likely[place[picture], column[policy.get(picture, answers[0])]] += 0.95
    starts = [even, likely, *(rng.dirichlet(np.ones(len(answers)), len(pictures)) for _ in range(RESTARTS))]
    row_of = [[place[graph.pictures[node]] for node, _, _ in walk.states] for walk in walks]
    return max(value, *(_climb(start.copy(), walks, row_of, column) for start in starts))


def _unfold(graph: Graph, watch: GoalWatch, horizon: int) -> _Walk:
    """Return every state that can be reached before the horizon."""
    limit = horizon // STRIDE
    number: dict[_State, int] = {(0, 0, 0): 0}
    layers: list[list[_State]] = [[] for _ in range(limit + 1)]
    layers[0].append((0, 0, 0))
    leads: dict[_State, dict[str, _State | int]] = {}
    for layer in layers:
        for state in layer:  # grows only in later layers: a move takes at least one stride
            node, memory, used = state
            leads[state] = {}
            for answer, move in graph.moves.get(node, {}).items():
                after, step = watch.advance(memory, move)
                if step is not None:
                    leads[state][answer] = _SUCCESS if used * STRIDE + step <= horizon else _FAILURE
                    continue
                later = (move.to, after, used + max(1, -(-move.steps // STRIDE)))
                if later[2] > limit:
                    leads[state][answer] = _FAILURE
                    continue
                if later not in number:
                    number[later] = len(number)
                    layers[later[2]].append(later)
                leads[state][answer] = later
    states = [state for layer in layers for state in layer]
    index = {state: k for k, state in enumerate(states)}
    ways = [
        {answer: index[to] if isinstance(to, tuple) else to for answer, to in leads[state].items()} for state in states
    ]
    return _pruned(_Walk(states, ways))


def _pruned(walk: _Walk) -> _Walk:
    """Return the walk without states from which the goal is out of reach; the start stays."""
    alive = [False] * len(walk.states)
    for k in range(len(alive) - 1, -1, -1):
        alive[k] = any(to == _SUCCESS or (to >= 0 and alive[to]) for to in walk.ways[k].values())
    kept = [k for k, lives in enumerate(alive) if lives or k == 0]
    index = {k: new for new, k in enumerate(kept)}
    return _Walk(
        [walk.states[k] for k in kept],
        [{answer: index.get(to, _FAILURE) if to >= 0 else to for answer, to in walk.ways[k].items()} for k in kept],
    )


def _climb(
    policy: np.ndarray, walks: Sequence[_Walk], rows: Sequence[Sequence[int]], column: Mapping[str, int]
) -> float:
    """Raise the success of ``policy`` (pictures, answers) until it stands still; return it."""
    value = 0.0
    for _ in range(ITERATIONS):
        used = np.zeros_like(policy)
        total = 0.0
        for walk, row in zip(walks, rows, strict=True):
            total += _expect(policy, walk, row, column, used)
        before, value = value, total / len(walks)
        if value - before < 1e-9:
            break
        weight = used.sum(axis=1, keepdims=True)
        policy = np.where(weight > 0, used / np.maximum(weight, 1e-300), policy)
    return value


def _expect(policy: np.ndarray, walk: _Walk, row: Sequence[int], column: Mapping[str, int], used: np.ndarray) -> float:
    """Add how often each answer is given in walks that succeed to ``used``; return the probability of success."""
    hope = np.zeros(len(walk.states))
    for k in range(len(walk.states) - 1, -1, -1):
        hope[k] = sum(
            policy[row[k], column[answer]] * (1.0 if to == _SUCCESS else hope[to] if to >= 0 else 0.0)
            for answer, to in walk.ways[k].items()
        )
    reach = np.zeros(len(walk.states))
    reach[0] = 1.0
    for k, ways in enumerate(walk.ways):
        if reach[k] == 0.0:
            continue
        for answer, to in ways.items():
            flow = reach[k] * policy[row[k], column[answer]]
            used[row[k], column[answer]] += flow * (1.0 if to == _SUCCESS else hope[to] if to >= 0 else 0.0)
            if to >= 0:
                reach[to] += flow
    return float(hope[0])
