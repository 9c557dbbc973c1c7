"""The alignment study: policies that differ in what their memory is aligned with, what they solve, what they know.

Everything is held equal but the arm: demonstrations, held-out episodes, seeds (weights, order of samples), updates,
rollouts. Policies are trained and rolled out by `studies.learning`. Then their averaged, frozen weights are asked, on
episodes never trained on, which subgoal is active (`readouts`) and how far their actions are off.
"""

from __future__ import annotations

import json
import time
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import torch
from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata
from lerobot.policies import make_policy, make_pre_post_processors

from lerobot_memobench.datasets.feature_cache.reading import RecordedFrames
from lerobot_memobench.datasets.lerobot_format.layout import DEFAULT_REPO_ID
from lerobot_memobench.io import write_file
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.processing.training_run import training_run
from lerobot_memobench.studies.alignment.figure import draw
from lerobot_memobench.studies.alignment.kept import KeptBaselines, KeptRun, kept_or_made
from lerobot_memobench.studies.alignment.measures import Measures
from lerobot_memobench.studies.alignment.questions import guesses, make_questions
from lerobot_memobench.studies.alignment.settings import ALIGNMENTS, StudySettings, claim_folder
from lerobot_memobench.studies.alignment.split import Split, split_episodes
from lerobot_memobench.studies.alignment.summary import measures_table, summarise
from lerobot_memobench.studies.learning.commands import Cost
from lerobot_memobench.studies.learning.contrasts import contrasts
from lerobot_memobench.studies.learning.experiments import MEMORY, Experiment
from lerobot_memobench.studies.learning.outcomes import as_json
from lerobot_memobench.studies.learning.running import Rolled, Say, train_and_roll_out
from lerobot_memobench.studies.learning.stages import Stages, name_of
from lerobot_memobench.studies.learning.tables import contrasts_table, costs_table, outcomes_table


class Study:
    """A dataset made ready, and policies trained on it; what is finished in its folder is read back.

    Args:
        root: folder of the dataset. out: folder of the study.
        workers: processes that train and roll out.
    """

    def __init__(self, root: Path, out: Path, settings: StudySettings, workers: int = 1) -> None:
        self.out, self.settings = out, settings
        self.split = split_episodes(root, settings.held_out)
        self.stages = Stages(experiment_of(self.split, settings), out, root, workers)
        meta = LeRobotDatasetMetadata(DEFAULT_REPO_ID, root=root)
        config = MemobenchMemConfig(size="small", perception="objects", device="cpu", push_to_hub=False)
        torch.manual_seed(0)
        self.untrained = make_policy(config, ds_meta=meta)
        self.before, _ = make_pre_post_processors(config, dataset_stats=meta.stats)
        run = training_run(config)
        assert run is not None  # the policy has begun it
        assert isinstance(run.cache, RecordedFrames)
        self.frames = run.cache
        self.questions = make_questions(self.frames, settings.level, self.split, settings.frames_per_episode)
        self.measures = Measures(self.frames, meta, self.split.tasks, self.questions)
        claim_folder(out, root, settings)  # now that it can be studied

    def baselines(self) -> dict[str, Any]:
        """Measure what needs no training."""
        return kept_or_made(self.out / "measures" / "baselines.json", KeptBaselines, self._baselines)

    def _baselines(self) -> dict[str, Any]:
        known = self.measures.of_memory(self.untrained.eval(), self.before)
        return guesses(self.questions) | {f"untrained_{name}": scores for name, scores in known.items()}

    def measured(self, arm: str, seed: int) -> dict[str, Any]:
        """Measure a policy that was trained."""
        path = self.out / "measures" / f"{name_of(arm, seed)}.json"
        return kept_or_made(path, KeptRun, lambda: self._measured(arm, seed))

    def _measured(self, arm: str, seed: int) -> dict[str, Any]:
        wall, cpu = time.monotonic(), time.process_time()
        found = self.measures.of_checkpoint(self.stages.checkpoint(arm, seed))
        took = {"wall_s": round(time.monotonic() - wall, 1), "cpu_s": round(time.process_time() - cpu, 1)}
        return {"arm": arm, "seed": seed, **found, **took}


def experiment_of(split: Split, settings: StudySettings) -> Experiment:
    """Return what is trained and rolled out: every arm on the episodes that are not held out."""
    return Experiment(
        split.tasks,
        episodes=0,
        steps=settings.steps,
        settings=(f"policy.subgoal_level={settings.level}", f"dataset.episodes={split.trained}", "save_freq=1000"),
        arms=ALIGNMENTS,
        seeds=settings.seeds,
        rollouts=settings.rollouts,
        first_seed=settings.first_seed,
        referent=split.referent,
    )


def run_study(root: Path, out: Path, settings: StudySettings, say: Say, workers: int = 1) -> tuple[str, Path]:
    """Do, or finish, a whole study; return its tables and the path of its figure, both written to ``out``.

    Args:
        say: told what begins. workers: processes; as many policies are trained at once, and share the cores.

    Raises:
        MemobenchError: the dataset cannot be studied, ``out`` holds another study, or a command failed.
    """
    study = Study(root, out, settings, workers)
    baselines = study.baselines()
    rolled = train_and_roll_out(study.stages, say)
    runs = []
    for seed, arm in product(range(settings.seeds), ALIGNMENTS):
        say(f"questions: {name_of(arm, seed)}")
        runs.append(study.measured(arm, seed))
    tables, summary = report(study, rolled, runs, baselines)
    write_file(out / "study.json", json.dumps(summary, indent=1))
    write_file(out / "study.md", tables + "\n")
    return tables, draw(summary, out / "alignment_study.png")


def report(
    study: Study, rolled: Rolled, runs: list[dict[str, Any]], baselines: dict[str, Any]
) -> tuple[str, dict[str, Any]]:
    """Return a study's tables, and all of its figures."""
    found, against = rolled.outcomes(), contrasts(rolled.rollouts, MEMORY)
    measures = {arm: summarise([run for run in runs if run["arm"] == arm]) for arm in ALIGNMENTS}
    costs = rolled.costs | {"questions": [Cost(run["wall_s"], run["cpu_s"]) for run in runs]}
    tables = (
        outcomes_table(found),
        contrasts_table(against, study.settings.seeds),
        measures_table(measures, baselines),
        costs_table(costs),
    )
    split, questions = study.split, study.questions
    summary = {
        "settings": asdict(study.settings),
        "tasks": split.tasks,
        "referent": split.referent,
        "episodes": {"trained": len(split.trained), "held_out": int(split.held.sum())},
        "candidates": len(questions.candidates),
        "frames": {"fit": len(questions.fit.indices), "test": len(questions.test.indices)},
        "outcomes": as_json(found),
        "differences": {arm: asdict(contrast) for arm, contrast in against.items()},
        "baselines": baselines,
        "measures": measures,
    }
    return "\n\n".join(tables), summary
