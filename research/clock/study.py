"""How often decisions are right that are taken from the present and the step, of episodes that were not learned from.

A scene at rest is the same however long it rests. So a demonstration stands for all lengths of idling, and is drawn
anew some times with each: the result rests on the draw as little as can be.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from numpy.typing import NDArray
from sklearn.ensemble import HistGradientBoostingClassifier
from sklearn.model_selection import GroupKFold
from sklearn.tree import DecisionTreeClassifier

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import IDLE_STEPS
from lerobot_memobench.tasks.catalogue import get_task
from research.clock.decisions import Decision, chance, read_decisions
from research.learning.results import markdown as table

DRAWS = 10
"""Idlings drawn for each demonstration."""
FOLDS = 5
MARGIN = 0.12
"""So much above chance may a decision without a memory be."""


class Result(TypedDict):
    """What was measured of a task; shares of right decisions.

    Attributes:
        family: of the task. demonstrations, decisions: how many. chance: see `decisions.chance`.
        right: by what they are taken from (`KINDS`), and by the most steps that the robot idles.
    """

    task: str
    family: str
    demonstrations: int
    decisions: int
    chance: float
    right: dict[str, dict[int, float]]


STEP, PRESENT, BOUND = KINDS = ("step", "present and step", "step, bound")
"""What a decision is taken from: the step and the instruction, by thresholds; all that is observed; and what no rule of
the step and the instruction can exceed."""


def study(folder: Path, idles: Sequence[int], seed: int = 0) -> Iterator[Result]:
    """Yield the result of each strict task in a dataset of demonstrations.

    Args:
        folder: the dataset. idles: most control steps that the robot idles; 0: it begins at once.
        seed: of the draws and the classifiers.

    Raises:
        MemobenchError: no such demonstrations, or fewer of a task than folds.
    """
    for name, found in read_decisions(folder).items():
        episodes = len({one.episode for one in found})
        check_enough(folder, name, episodes)
        fitted = {idle: _fitted_right(found, idle, seed) for idle in idles}
        task = get_task(name)
        yield Result(
            task=name,
            family=task.family,
            demonstrations=episodes,
            decisions=len(found),
            chance=chance(task, found),
            right={
                STEP: {idle: step for idle, (step, _) in fitted.items()},
                PRESENT: {idle: present for idle, (_, present) in fitted.items()},
                BOUND: {idle: bound(found, idle) for idle in idles},
            },
        )


def check_enough(folder: Path, name: str, episodes: int) -> None:
    """Refuse fewer demonstrations of a task than there are folds.

    Raises:
        MemobenchError: there are.
    """
    if episodes < FOLDS:
        raise MemobenchError(f"{folder} holds {episodes} demonstrations of {name}; at least {FOLDS} are needed")


def bound(found: Sequence[Decision], idle: int) -> float:
    """Return the share of right decisions of the best rule of the step and the instruction; 1 without idling.

    It knows when each of these decisions is taken, and is no estimate: at a step it gives the answer that is the most
    likely one there.
    """
    right = 0.0
    steps = np.arange(max(one.step for one in found) + idle + 1)
    for instruction in {one.present[-1] for one in found}:
        likely: dict[str, NDArray[np.float64]] = {}
        for one in found:
            if one.present[-1] == instruction:
                there = (steps >= one.step) & (steps <= one.step + idle)
                likely[one.answer] = likely.get(one.answer, np.zeros(len(steps))) + there / (idle + 1)
        right += float(np.max([*likely.values()], axis=0).sum())
    return right / len(found)


def _fitted_right(found: Sequence[Decision], idle: int, seed: int) -> tuple[float, float]:
    """Return the shares of right decisions: from the step and the instruction, and from all of the present."""
    rng = np.random.default_rng(seed)
    numbers, of_episode = np.unique([one.episode for one in found], return_inverse=True)
    waited = rng.integers(idle, endpoint=True, size=(DRAWS if idle else 1, len(numbers)))
    steps = (np.array([one.step for one in found]) + waited[:, of_episode]).ravel()
    present = np.tile([one.present for one in found], (len(waited), 1))
    present = present[:, np.ptp(present, axis=0) > 0]  # an empty slot tells nothing
    instruction = np.tile([one.present[-1] for one in found], len(waited))
    answers = np.unique(np.tile([one.answer for one in found], len(waited)), return_inverse=True)[1]
    groups = np.tile(of_episode, len(waited))
    by_step, by_all = np.column_stack([instruction, steps]), np.column_stack([present, steps])
    right = np.zeros((2, len(answers)), np.bool_)
    for train, test in GroupKFold(FOLDS).split(by_step, answers, groups):
        for row, inputs in enumerate((by_step, by_all)):
            right[row, test] = _fitted(row, inputs[train], answers[train], seed).predict(inputs[test]) == answers[test]
    return float(right[0].mean()), float(right[1].mean())


def _fitted(row: int, inputs: NDArray[np.float64], answers: NDArray[np.int64], seed: int) -> Any:
    """Return a classifier: thresholds, one fewer for each instruction than there are answers; or boosted trees."""
    if row:
        return HistGradientBoostingClassifier(max_iter=60, max_leaf_nodes=8, random_state=seed).fit(inputs, answers)
    leaves = len(np.unique(answers)) * len(np.unique(inputs[:, 0]))
    return DecisionTreeClassifier(max_leaf_nodes=max(leaves, 2), random_state=seed).fit(inputs, answers)


def markdown(results: Sequence[Result]) -> str:
    """Return a table, per cent, and below it what exceeds chance by more than `MARGIN` with the present idling."""
    idles = list(results[0]["right"][STEP])
    heads = [f"idle {idle}: {kind}" for idle in idles for kind in KINDS]
    rows = []
    for one in results:
        shares = [one["chance"], *(one["right"][kind][idle] for idle in idles for kind in KINDS)]
        counts = [f"{one['demonstrations']}", f"{one['decisions']}"]
        rows.append([f"{one['family']}: `{one['task']}`", *counts, *(f"{100 * share:.0f}" for share in shares)])
    told = table(["task", "demonstrations", "decisions", "chance", *heads], rows)
    return "\n".join([told, "", *_verdict(results)])


def _verdict(results: Sequence[Result]) -> Iterator[str]:
    if IDLE_STEPS not in results[0]["right"][STEP]:
        return
    above: Mapping[str, float] = {
        one["task"]: max(one["right"][kind][IDLE_STEPS] for kind in KINDS) - one["chance"] for one in results
    }
    worst = max(above, key=lambda name: above[name])
    over = sum(value > MARGIN for value in above.values())
    yield (
        f"With {IDLE_STEPS} steps the best of the three is more than {100 * MARGIN:.0f} points above chance in "
        f"{over} of {len(results)} tasks, at most {100 * above[worst]:.0f} points (`{worst}`)."
    )
