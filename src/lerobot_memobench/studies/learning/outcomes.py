"""What the rollouts of an experiment show: success, and of the failures, how many were wrong about what was seen."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.evaluation.metrics.rates import Rate, mean_rate, success_rate
from lerobot_memobench.evaluation.metrics.rollouts import Record, by_task
from lerobot_memobench.studies.learning.contrasts import Runs
from lerobot_memobench.tasks.failures import REFERENCE_DRIFT, WRONG_ORDER
from lerobot_memobench.tasks.task import MEMORY_TYPES, STRICT_FAILURES

WRONG = (REFERENCE_DRIFT, WRONG_ORDER, *STRICT_FAILURES)
"""Failures that are a memory's and no hand's: a wrong referent, order, place or count."""


@dataclass(frozen=True)
class Outcome:
    """Rollouts of one arm on one or several tasks, all training seeds together.

    Attributes:
        success: over all rollouts, or the mean of tasks.
        of_seeds: the same of each training seed.
        wrong: rollouts that failed with a wrong referent, order, place or count. others: that failed otherwise.
    """

    success: Rate
    of_seeds: tuple[float, ...]
    wrong: int
    others: int

    @property
    def wrong_share(self) -> float:
        """What share of rollouts failed as ``wrong`` ones, tasks averaged as in ``success``, about."""
        failures = self.wrong + self.others
        return (1 - _value(self.success)) * self.wrong / failures if failures else 0.0


def outcomes_of(rollouts: Runs) -> dict[str, Outcome]:
    """Return "all", memory type and task -> outcome, of an arm's rollouts.

    "all" is the mean over memory types of the mean over tasks, as in the paper.
    """
    runs = [by_task(records) for records in rollouts]
    tasks = list(runs[0])
    found = {task: _outcome([[run[task]] for run in runs]) for task in tasks}
    type_of = {task: str(runs[0][task][0]["memory_type"]) for task in tasks}
    groups = {kind: [task for task in tasks if type_of[task] == kind] for kind in MEMORY_TYPES}
    types: dict[str, Outcome] = {
        kind: _outcome([[run[task] for task in own] for run in runs]) for kind, own in groups.items() if own
    }
    return {"all": _mean(types.values()), **types, **found}


def _outcome(runs: Sequence[Sequence[Sequence[Record]]]) -> Outcome:
    """Put together the rollouts of one or several tasks, (training seed, task, rollout)."""
    tasks = [[record for run in runs for record in run[k]] for k in range(len(runs[0]))]
    failures = [record.get("failure") for group in tasks for record in group if not record["success"]]
    wrong = sum(failure in WRONG for failure in failures)
    return Outcome(
        success=mean_rate([success_rate(group) for group in tasks]),
        of_seeds=tuple(_value(mean_rate([success_rate(group) for group in run])) for run in runs),
        wrong=wrong,
        others=len(failures) - wrong,
    )


def _mean(types: Iterable[Outcome]) -> Outcome:
    types = list(types)
    seeds = zip(*(outcome.of_seeds for outcome in types), strict=True)
    return Outcome(
        success=mean_rate([outcome.success for outcome in types]),
        of_seeds=tuple(sum(values) / len(values) for values in seeds),
        wrong=sum(outcome.wrong for outcome in types),
        others=sum(outcome.others for outcome in types),
    )


def _value(rate: Rate) -> float:
    assert rate.value is not None  # there are rollouts
    return rate.value


def as_json(arms: Mapping[str, Mapping[str, Outcome]]) -> dict[str, Any]:
    """Return arm -> scope -> figures, rates in per cent."""
    return {arm: {scope: _figures(outcome) for scope, outcome in found.items()} for arm, found in arms.items()}


def _figures(outcome: Outcome) -> dict[str, Any]:
    low, high = outcome.success.interval or (None, None)
    return {
        "success": outcome.success.value,
        "interval": [low, high],
        "rollouts": outcome.success.n,
        "of_seeds": list(outcome.of_seeds),
        "wrong": outcome.wrong,
        "wrong_share": outcome.wrong_share,
        "other_failures": outcome.others,
    }
