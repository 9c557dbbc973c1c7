"""The best probabilities of answers given the picture, when any order will do and a wrong answer may be mended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.necessity.best_map import best_map
from lerobot_memobench.evaluation.necessity.graph import LOST, GoalWatch, Graph
from lerobot_memobench.tasks.formula import Formula

STRIDE = 25
"""Steps are counted in multiples of this when probabilities are optimised, rounded up: a move never gets cheaper."""
RESTARTS, ITERATIONS = 4, 200

_State = tuple[int, int, int]
"""Node, memory, steps used / `STRIDE`."""
_SUCCESS, _FAILURE = -2, -1
"""Where an answer leads beside to other states; they are the last two places of an array over states."""


_Layers = list[dict[_State, dict[str, _State | int]]]
"""By time used: state -> answer -> where it leads, a state, `_SUCCESS` or `_FAILURE`."""


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


def best_probabilities(
    graph: Graph, goals: Sequence[Formula], horizon: int, starts: Sequence[int] = (), seed: int = 0
) -> float:
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
    rng = np.random.default_rng(seed)
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
