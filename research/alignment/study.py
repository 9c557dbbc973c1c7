"""The alignment study: policies that differ in what their memory is aligned with, what they solve, what they know.

Everything is held equal but the arm: demonstrations, held-out episodes, seeds (weights, order of samples), updates,
rollouts. Policies are trained and rolled out by `research.learning`. Then their averaged, frozen weights are asked, on
episodes never trained on, which subgoal is active and how far their actions are off (`measures`).
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any, NotRequired, TypedDict

import torch
from lerobot.configs.default import DatasetConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.constants import OBS_IMAGES

from lerobot_memobench.datasets.lerobot_format.layout import DEFAULT_REPO_ID
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Number, read_json, write_file
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.protocol import CAMERAS, EVALUATION_SEED
from lerobot_memobench.training.data import open_datasets, open_training
from lerobot_memobench.training.features import dataset_fingerprint
from research.alignment.measures import Measures, Split, guesses, make_questions, split_episodes
from research.alignment.report import draw, measures_table, summarise
from research.learning.experiments import MEMORY, MEMORYLESS, Experiment
from research.learning.results import as_json, contrasts, contrasts_table, costs_table, outcomes_table
from research.learning.stages import Cost, Stages, name_of
from research.learning.study import Rolled, Say, train_and_roll_out

ALIGNMENTS: dict[str, tuple[str, ...]] = {
    MEMORY: (),
    **{name: (f"align={name}",) for name in ("semantic", "contrastive", "framewise")},
    "oracle text": ("policy.memory_fusion=none", "policy.oracle_memory=true"),
    MEMORYLESS: ("policy.memory_fusion=none",),
}
"""The paper's objectives beside a memory that is aligned with nothing, and the two ends: what was seen told in words,
and nothing of it. Name -> words for `lerobot train`."""


@dataclass(frozen=True)
class StudySettings:
    """What a study does.

    Attributes:
        steps: updates of each policy. seeds: of training; the first ``seeds`` numbers.
        held_out: episodes of each task, its last ones, that are never trained on.
        rollouts: of each task and policy. first_seed: of the rollouts.
        level: of the subgoals that memories are aligned with and asked for.
        frames_per_episode: execution frames, evenly spaced, that are asked about.
    """

    steps: int = 3000
    seeds: int = 3
    held_out: int = 4
    rollouts: int = 20
    first_seed: int = EVALUATION_SEED
    level: str = "intermediate"
    frames_per_episode: int = 24


def claim_folder(out: Path, root: Path, settings: StudySettings) -> None:
    """Make ``out`` the folder of a study of the dataset at ``root``; more seeds may be added to one that is there.

    Raises:
        MemobenchError: it holds a study of another dataset, or with other settings.
    """
    wanted = {"dataset": dataset_fingerprint(root, f"{OBS_IMAGES}.{next(iter(CAMERAS))}"), **asdict(settings)}
    del wanted["seeds"]
    path = out / "settings.json"
    if path.is_file():
        there = read_json(path, dict[str, Any], "name another --out, or remove the file")
        different = [key for key in wanted if there.get(key) != wanted[key]]
        if different:
            raise MemobenchError(
                f"{out} holds a study with another {', '.join(different)}; name another --out, or give "
                "the settings in its settings.json"
            )
    out.mkdir(parents=True, exist_ok=True)
    write_file(path, json.dumps(wanted, indent=1))


# --- what is kept ---


class Scores(TypedDict):
    """Top-1 among all subgoals, and among those of the frame's task."""

    all: Number
    own_task: Number


class KeptRun(TypedDict):
    """What was measured on a trained policy: its actions, and its memory if it has one; seconds that this took."""

    arm: str
    seed: Count
    memory: NotRequired[Scores]
    last_frame: NotRequired[Scores]
    head: NotRequired[Scores]
    action_loss: float
    wall_s: Number
    cpu_s: Number


class KeptBaselines(TypedDict):
    """What needs no training."""

    chance: Scores
    commonest: Scores
    untrained_memory: Scores
    untrained_last_frame: Scores


def kept_or_made(path: Path, schema: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what ``path`` holds; where there is no such file, what ``make`` returns, written there.

    Raises:
        MemobenchError: the file is not of the schema. It may have taken hours, so it is not replaced.
    """
    try:
        kept: dict[str, Any] = read_json(path, schema, "remove it, and the run is made again", nan=True)
    except FileNotFoundError:
        kept = make()
        path.parent.mkdir(exist_ok=True)
        write_file(path, json.dumps(kept, indent=1))
    return kept


# --- the study ---


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
        config = MemobenchMemConfig(size="small", perception="objects", device="cpu", push_to_hub=False)
        torch.manual_seed(0)
        whole = TrainPipelineConfig(DatasetConfig(DEFAULT_REPO_ID, root=str(root)), policy=config)
        training = open_training(whole, open_datasets(whole))
        self.untrained, self.frames = training.policy, training.lookup
        self.before, _ = training.processors
        self.questions = make_questions(self.frames, settings.level, self.split, settings.frames_per_episode)
        self.measures = Measures(self.frames, training.dataset.meta, self.split.tasks, self.questions)
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


def _aligned(words: tuple[str, ...]) -> bool:
    return any(word.startswith("align=") for word in words)


def experiment_of(split: Split, settings: StudySettings) -> Experiment:
    """Return what is trained and rolled out: every arm on the episodes that are not held out."""
    return Experiment(
        split.tasks,
        episodes=0,
        steps=settings.steps,
        settings=(f"dataset.episodes={split.trained}", "save_freq=1000"),
        arms={
            arm: (*words, *([f"policy.subgoal_level={settings.level}"] if _aligned(words) else []))
            for arm, words in ALIGNMENTS.items()
        },
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
        contrasts_table(against),
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
