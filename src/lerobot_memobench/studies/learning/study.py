"""An experiment from no data to a table: demonstrations, one policy per arm and training seed, their rollouts."""

from __future__ import annotations

import json
from pathlib import Path

from lerobot_memobench.evaluation.documents.sentences import saw_phrase
from lerobot_memobench.evaluation.metrics.rollouts import saw
from lerobot_memobench.io import write_file
from lerobot_memobench.studies.learning.contrasts import contrasts
from lerobot_memobench.studies.learning.experiments import MEMORY, Experiment
from lerobot_memobench.studies.learning.figure import draw
from lerobot_memobench.studies.learning.outcomes import as_json
from lerobot_memobench.studies.learning.running import Costs, Say, train_and_roll_out
from lerobot_memobench.studies.learning.stages import Stages
from lerobot_memobench.studies.learning.tables import contrasts_table, costs_table, outcomes_table


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
    against = contrasts_table(contrasts(rolled.rollouts, MEMORY), experiment.seeds)
    seen = "; ".join(
        f"{arm}: {saw_phrase(saw([record for run in runs for record in run]))}" for arm, runs in rolled.rollouts.items()
    )
    text = f"{outcomes_table(found)}\n\n{seen}.\n\n{against}\n\n{costs_table(costs | rolled.costs)}\n"
    write_file(out / "learning.md", text)
    return text
