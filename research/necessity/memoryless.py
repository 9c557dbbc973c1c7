"""How far a policy without memory can come: aliased frames, chance and ceilings. Pure: no simulator.

A *history* is one demonstrated episode seen as a row of decisions; a decision is the picture that is seen before it
(as the number of a class of equal pictures) and the answer that is right in this history. A policy
without memory is a map from pictures to answers, or to probabilities of answers. It passes a history when it gives the
right answer at each of its decisions; one wrong answer fails (trying again is the subject of
`graph`).

Histories of one scene are weighed together: they may lead to the same pictures.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

RESTARTS = 16
"""Random starts of the search for the best probabilities, in addition to the even one."""
ITERATIONS = 2000


@dataclass(frozen=True)
class Decision:
    """A frame at which the demonstrator turned to something new.

    Attributes:
        picture: class of the images; equal numbers look the same.
        answer: the next subtask, e.g. ``Open wooden_cabinet_1_top_region``.
    """

    picture: int
    answer: str


History = tuple[Decision, ...]


def classes(difference: NDArray[np.floating], tolerance: float) -> list[int]:
    """Return a class number per picture: the connected parts of "differs by at most the tolerance".

    Args:
        difference: (n, n), symmetric.
    """
    from scipy.sparse.csgraph import connected_components

    _, parts = connected_components(difference <= tolerance, directed=False)
    _, first = np.unique(parts, return_index=True)
    return [int(first[part]) for part in parts]


def right_answers(histories: Sequence[History]) -> dict[int, list[str]]:
    """Return per picture the answers that are right in some history, in order of appearance."""
    answers: dict[int, list[str]] = {}
    for history in histories:
        for decision in history:
            known = answers.setdefault(decision.picture, [])
            if decision.answer not in known:
                known.append(decision.answer)
    return answers


def aliased(histories: Sequence[History]) -> dict[int, list[str]]:
    """Return the pictures at which more than one answer is right, and those answers."""
    return {picture: answers for picture, answers in right_answers(histories).items() if len(answers) > 1}


def chance(histories: Sequence[History]) -> float:
    """Return the success of a policy that knows the routine and guesses evenly where the picture does not decide.

    Histories are equally likely. Where every picture has one right answer this is 1.
    """
    answers = right_answers(histories)
    passes = [float(np.prod([1.0 / len(answers[decision.picture]) for decision in history])) for history in histories]
    return sum(passes) / len(passes)


def deterministic_ceiling(histories: Sequence[History]) -> float:
    """Return the largest share of equally likely histories that one fixed map from pictures to answers passes."""
    demands = [_demands(history) for history in histories]
    possible = [(index, demand) for index, demand in enumerate(demands) if demand is not None]

    def most(start: int, taken: dict[int, str]) -> int:
        best = 0
        for place in range(start, len(possible)):
            demand = possible[place][1]
            if all(taken.get(picture, answer) == answer for picture, answer in demand.items()):
                best = max(best, 1 + most(place + 1, {**taken, **demand}))
            if best == len(possible) - start:
                break
        return best

    return most(0, {}) / len(histories)


def _demands(history: History) -> dict[int, str] | None:
    """Return which answer each picture must have; None when one picture would need two."""
    demand: dict[int, str] = {}
    for decision in history:
        if demand.setdefault(decision.picture, decision.answer) != decision.answer:
            return None
    return demand


def stochastic_ceiling(histories: Sequence[History]) -> float:
    """Return the success of the best probabilities of answers given the picture; each decision has one try.

    For one history the maximum is known: answer each picture as often as it needs each answer. For several, it is
    looked for by expectation maximisation from several starts (each round cannot do worse than the last), and is at
    least the deterministic ceiling.
    """
    answers = right_answers(histories)
    counts = [Counter((decision.picture, decision.answer) for decision in history) for history in histories]
    rng = np.random.default_rng(0)
    best = deterministic_ceiling(histories)
    for start in range(RESTARTS + 1):
        policy = {
            (picture, answer): p
            for picture, known in answers.items()
            for answer, p in zip(
                known,
                rng.dirichlet(np.ones(len(known))) if start else np.full(len(known), 1.0 / len(known)),
                strict=True,
            )
        }
        best = max(best, _climb(policy, answers, counts))
    return best


def _climb(
    policy: dict[tuple[int, str], float],
    answers: dict[int, list[str]],
    counts: Sequence[Counter[tuple[int, str]]],
) -> float:
    value = 0.0
    for _ in range(ITERATIONS):
        passes = [float(np.prod([policy[key] ** n for key, n in count.items()])) for count in counts]
        before, value = value, sum(passes) / len(passes)
        if value - before < 1e-12:
            break
        used = dict.fromkeys(policy, 0.0)
        for passed, count in zip(passes, counts, strict=True):
            for key, n in count.items():
                used[key] += passed * n
        for picture, known in answers.items():
            total = sum(used[picture, answer] for answer in known)
            if total > 0:
                policy.update({(picture, answer): used[picture, answer] / total for answer in known})
    return value
