"""An experiment from no data to a table: demonstrations, one policy per arm and training seed, their rollouts."""

from __future__ import annotations

import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path

from lerobot_memobench.evaluation.records.runs import read_rollouts
from lerobot_memobench.files import write_file
from lerobot_memobench.studies.learning.commands import Cost
from lerobot_memobench.studies.learning.contrasts import Contrast, contrasts
from lerobot_memobench.studies.learning.experiments import MEMORY, Experiment
from lerobot_memobench.studies.learning.figure import draw
from lerobot_memobench.studies.learning.outcomes import Outcome, as_json, outcomes_of
from lerobot_memobench.studies.learning.stages import Stages, name_of

Say = Callable[[str], None]

COLUMNS = ("", "success", "95 % interval", "training seeds", "wrong referent", "other failures")
PARTS = ("data", "training", "evaluation")


def learn(experiment: Experiment, out: Path, say: Say, *, dataset: Path | None = None, workers: int = 1) -> str:
    """Do, or finish, an experiment in ``out``; return its tables, written there as well, with a picture (`figure`).

    Args:
        say: told what begins and what it took.
        dataset: demonstrations that are there already.
        workers: processes; with more than one, as many policies are trained at once, on one core each.
    """
    stages = Stages(experiment, out, dataset, workers)
    say(f"demonstrations: {experiment.episodes} of each of {len(experiment.tasks)} tasks, to {stages.data}")
    costs = {"data": [stages.generate()]}
    everyone = list(product(range(experiment.seeds), experiment.arms))
    with ThreadPoolExecutor(workers) as pool:

        def train(one: tuple[int, str]) -> Cost:
            seed, arm = one
            say(f"training: {name_of(arm, seed)}, {experiment.steps} updates; see {stages.log('training', arm, seed)}")
            return stages.train(arm, seed, threads=1 if workers > 1 else None)

        costs["training"] = list(pool.map(train, everyone))
    for seed, arm in everyone:
        say(f"evaluation: {name_of(arm, seed)}; see {stages.log('evaluation', arm, seed)}")
        costs.setdefault("evaluation", []).append(stages.evaluate(arm, seed))
    seeds = range(experiment.seeds)
    rollouts = {arm: [read_rollouts(stages.rollouts(arm, seed))[0] for seed in seeds] for arm in experiment.arms}
    found = {arm: outcomes_of(runs) for arm, runs in rollouts.items()}
    write_file(out / "learning.json", json.dumps(as_json(found), indent=1))
    draw(found, out / "learning.png")
    against = contrasts_table(contrasts(rollouts, MEMORY), experiment.seeds)
    text = f"{outcomes_table(found)}\n\n{against}\n\n{costs_table(costs)}\n"
    write_file(out / "learning.md", text)
    return text


def outcomes_table(arms: dict[str, dict[str, Outcome]]) -> str:
    """Return a table of all arms and scopes; a mean over several tasks comes before its tasks."""
    scopes = list(next(iter(arms.values())))
    several = len(scopes) > 3  # one task has itself, its type and the mean
    rows = [
        [f"{scope}, {arm}", *_cells(arms[arm][scope])] for scope in (scopes if several else scopes[-1:]) for arm in arms
    ]
    return _table(COLUMNS, rows)


def _cells(outcome: Outcome) -> list[str]:
    low, high = outcome.success.interval or (0.0, 0.0)
    value = outcome.success.value or 0.0
    seeds = ", ".join(f"{100 * each:.0f}" for each in outcome.of_seeds)
    return [f"{100 * value:.1f}", f"{100 * low:.1f}–{100 * high:.1f}", seeds, str(outcome.wrong), str(outcome.others)]


def contrasts_table(found: dict[str, Contrast], seeds: int) -> str:
    """Return a table of arms against the one with a memory that is aligned with nothing."""
    rows = [
        [
            f"{name} less {MEMORY}",
            *(f"{100 * one.value:+.1f}", f"{100 * one.low:+.1f} to {100 * one.high:+.1f}", f"{one.p:.3f}"),
            "–" if one.detectable is None else f"{100 * one.detectable:.1f}",
        ]
        for name, one in found.items()
    ]
    trained = f"95 % interval, {seeds} training seed{'s' if seeds > 1 else ''}"
    return _table(("", "difference, points", trained, "p (Holm)", "detectable"), rows)


def costs_table(costs: dict[str, list[Cost | None]]) -> str:
    """Return what each part took: minutes of the longest command of a part, and of processors in all."""
    rows = []
    for part in PARTS:
        told = [cost for cost in costs[part] if cost is not None]
        wall = max((cost.wall_s for cost in told), default=0.0)
        rows.append([part, str(len(told)), f"{wall / 60:.1f}", f"{sum(cost.cpu_s for cost in told) / 60:.1f}"])
    return _table(("part", "commands", "longest, min", "CPU min in all"), rows)


def _table(header: tuple[str, ...], rows: list[list[str]]) -> str:
    lines = [list(header), ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
