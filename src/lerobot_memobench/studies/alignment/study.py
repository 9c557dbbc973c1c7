"""The alignment study: the same small policy trained with each objective, and what its memory then knows.

Everything is held equal but the objective: dataset, split, seeds (weights, batches, noise), updates. A run trains
through the policy's own ``forward``, its preprocessor, optimiser, schedule and weight average. The averaged weights are
then frozen and asked, on episodes never trained on, which subgoal is active (`readouts`) and how far their actions are
off.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lerobot.policies import make_policy

from lerobot_memobench.datasets.memory_cache import MemoryCache, read_meta
from lerobot_memobench.files import write_file
from lerobot_memobench.files.reading import read_json
from lerobot_memobench.policies.memobench_mem.caching import cache_dataset
from lerobot_memobench.studies.alignment.baselines import measure_baselines
from lerobot_memobench.studies.alignment.figure import draw
from lerobot_memobench.studies.alignment.frames import Frames, Say
from lerobot_memobench.studies.alignment.kept import KeptBaselines, KeptRun, kept_or_made
from lerobot_memobench.studies.alignment.measures import Measures
from lerobot_memobench.studies.alignment.questions import make_questions
from lerobot_memobench.studies.alignment.settings import ALIGNMENTS, StudySettings, claim_folder
from lerobot_memobench.studies.alignment.split import split_frames
from lerobot_memobench.studies.alignment.summary import markdown_table, summarise
from lerobot_memobench.studies.alignment.training import Trained, train


class Study:
    """A dataset made ready, and runs on it; what is finished in its folder is read back.

    Args:
        root: folder of the dataset. out: folder of the study. say: told what is going on.
    """

    def __init__(self, root: Path, out: Path, settings: StudySettings, say: Say) -> None:
        self.out, self.settings, self.say = out, settings, say
        claim_folder(out, root, settings)
        self.frames = Frames(root, out / "frames", say)
        config = settings.config("semantic")
        folder = cache_dataset(root, config, progress=lambda done, count: say(f"memory cache: {done} of {count}"))
        meta = read_meta(root, folder.name)
        assert meta is not None  # it was made a moment ago
        self.cache = MemoryCache.open(
            root,
            folder.name,
            frames_key=meta.frames_key,
            camera=meta.camera,
            stride=meta.stride,
            texts_key=meta.texts_key,
        )
        self.split = split_frames(self.frames, self.cache.phase, settings)
        self.questions = make_questions(self.cache, settings.level, self.split, self.frames.tasks)
        self.measures = Measures(self.cache, self.frames, self.questions, config.memory_frames, settings.action_batches)

    def run(self, align: str, seed: int) -> dict[str, Any]:
        """Train and measure one policy."""
        return self._once(f"{align}-{seed}", KeptRun, lambda: self._run(align, seed))

    def baselines(self) -> dict[str, Any]:
        """Measure what needs no training."""
        return self._once("baselines", KeptBaselines, self._baselines)

    def _once(self, name: str, schema: Any, work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return a finished result of that name, or do the work and write it."""
        return kept_or_made(self.out / "runs" / f"{name}.json", schema, work)

    def _run(self, align: str, seed: int) -> dict[str, Any]:
        started = time.process_time()
        trained = train(self.settings, self.frames, self.split.train, align, seed, self.say)
        ended = time.process_time()
        policy = trained.policy.eval()
        assert policy.average is not None
        with policy.average.applied():
            measured = self.measures.of_policy(policy, trained.before)
        if seed == 0:
            self._save(trained, align)
        return {
            "align": align,
            "seed": seed,
            **measured,
            "curve": trained.curve,
            "train_cpu_s": round(ended - started, 1),
            "measure_cpu_s": round(time.process_time() - ended, 1),
        }

    def _save(self, trained: Trained, align: str) -> None:
        """Write a checkpoint for ``lerobot eval``."""
        for part in (trained.policy, trained.before, trained.after):
            part.save_pretrained(self.out / "checkpoints" / align / "pretrained_model")

    def _baselines(self) -> dict[str, Any]:
        torch.manual_seed(0)
        untrained = make_policy(self.settings.config("none", self.frames.features), ds_meta=self.frames.meta)
        return measure_baselines(self.measures, untrained)


def run_study(root: Path, out: Path, settings: StudySettings, say: Say) -> tuple[str, Path]:
    """Do, or finish, a whole study; return its table and the path of its figure, both written to ``out``."""
    study = Study(root, out, settings, say)
    baselines = study.baselines()
    # Seed by seed, so that an unfinished study already compares all objectives.
    runs = [study.run(align, seed) for seed in range(settings.seeds) for align in ALIGNMENTS]
    summary = {
        "settings": read_json(out / "settings.json", dict[str, Any], "it has changed") | {"seeds": settings.seeds},
        "tasks": len(set(study.frames.tasks.tolist())),
        "episodes": len(study.frames.episodes) - 1,
        "candidates": len(study.questions.candidates),
        "frames": {"fit": len(study.split.fit), "test": len(study.split.test), "train": len(study.split.train)},
        "baselines": baselines,
        "alignments": {align: summarise([run for run in runs if run["align"] == align]) for align in ALIGNMENTS},
    }
    table = markdown_table(summary)
    write_file(out / "study.json", json.dumps(summary, indent=1))
    write_file(out / "study.md", table + "\n")
    return table, draw(summary, out / "alignment_study.png")
