"""The trainings and rollouts of an experiment, one command after another, and what they leave."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product

from lerobot_memobench.evaluation.records.runs import read_rollouts
from lerobot_memobench.studies.learning.commands import Cost
from lerobot_memobench.studies.learning.contrasts import Runs
from lerobot_memobench.studies.learning.outcomes import Outcome, outcomes_of
from lerobot_memobench.studies.learning.stages import Stages, name_of

Say = Callable[[str], None]
Costs = dict[str, list[Cost | None]]
"""Part of an experiment -> what each of its commands took; None for one that was not needed."""


@dataclass(frozen=True)
class Rolled:
    """Policies that were trained and rolled out.

    Attributes:
        rollouts: arm -> rollouts of each training seed. costs: of training and evaluation.
    """

    rollouts: dict[str, Runs]
    costs: Costs

    def outcomes(self) -> dict[str, dict[str, Outcome]]:
        """Return arm -> scope -> outcome (`outcomes_of`)."""
        return {arm: outcomes_of(runs) for arm, runs in self.rollouts.items()}


def train_and_roll_out(stages: Stages, say: Say) -> Rolled:
    """Train every arm with every seed, then roll each out; what was done before is not done again.

    With several workers as many policies are trained at once; they share the cores.

    Args:
        say: told what begins.
    """
    experiment = stages.experiment
    # Seed by seed, so that an unfinished experiment already compares all arms.
    everyone = list(product(range(experiment.seeds), experiment.arms))

    def train(one: tuple[int, str]) -> Cost:
        seed, arm = one
        say(f"training: {name_of(arm, seed)}, {experiment.steps} updates; see {stages.log('training', arm, seed)}")
        return stages.train(arm, seed)

    def roll_out(one: tuple[int, str]) -> Cost:
        seed, arm = one
        say(f"evaluation: {name_of(arm, seed)}; see {stages.log('evaluation', arm, seed)}")
        return stages.evaluate(arm, seed)

    with ThreadPoolExecutor(stages.workers) as pool:
        costs: Costs = {"training": list(pool.map(train, everyone))}
    costs["evaluation"] = [roll_out(one) for one in everyone]
    seeds = range(experiment.seeds)
    rollouts: dict[str, Runs] = {
        arm: [read_rollouts(stages.rollouts(arm, seed))[0] for seed in seeds] for arm in experiment.arms
    }
    return Rolled(rollouts, costs)
