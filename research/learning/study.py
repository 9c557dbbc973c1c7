"""An experiment from no data to a table: demonstrations, a policy per arm and training seed, their rollouts."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from lerobot_memobench.evaluation.metrics import policy_inputs
from lerobot_memobench.evaluation.records import read_rollouts
from lerobot_memobench.evaluation.report_tables import inputs_phrase
from lerobot_memobench.io import write_file
from research.learning.experiments import MEMORY, Experiment
from research.learning.results import (
    Outcome,
    Runs,
    as_json,
    contrasts,
    contrasts_table,
    costs_table,
    draw,
    outcomes_of,
    outcomes_table,
)
from research.learning.stages import Cost, Costs, Stages, name_of

Say = Callable[[str], None]


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


def learn(experiment: Experiment, out: Path, say: Say, *, dataset: Path | None = None, workers: int = 1) -> str:
    """Do, or finish, an experiment in ``out``; return its tables, written there as well, with a picture (`figure`).

    Args:
        say: told what begins.
        dataset: demonstrations that are there already.
        workers: processes; with more than one, as many policies are trained at once, and share the cores.
    """
    stages = Stages(experiment, out, dataset, workers)
    stages.check_settings()
    more = "" if experiment.prompted_episodes is None else f" ({experiment.prompted_episodes} where it has a prompt)"
    say(f"demonstrations: {experiment.episodes} of each of {len(experiment.tasks)} tasks{more}, to {stages.data}")
    costs: Costs = {"data": [stages.generate()]}
    rolled = train_and_roll_out(stages, say)
    found = rolled.outcomes()
    write_file(out / "learning.json", json.dumps(as_json(found), indent=1))
    draw(found, out / "learning.png")
    against = contrasts_table(contrasts(rolled.rollouts, MEMORY))
    seen = "; ".join(
        f"{arm}: {inputs_phrase(policy_inputs([record for run in runs for record in run]))}"
        for arm, runs in rolled.rollouts.items()
    )
    text = f"{outcomes_table(found)}\n\n{seen}.\n\n{against}\n\n{costs_table(costs | rolled.costs)}\n"
    write_file(out / "learning.md", text)
    return text
