"""The three parts of an experiment, each a command of ours: demonstrations, policies, rollouts."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.run.arguments import split_words
from lerobot_memobench.studies.learning.commands import Cost, run_once
from lerobot_memobench.studies.learning.experiments import PERCEPTIONS, Experiment, Sight
from lerobot_memobench.tasks.catalogue import suite_of
from lerobot_memobench.tasks.task import STRICT

SHARED = ("policy=memobench_mem", "size=small", "save_freq=2000")
"""What every policy of an experiment is told; a run that is killed goes on from its last checkpoint."""


@dataclass(frozen=True)
class Stages:
    """An experiment in a folder; what has been done there is not done again.

    Args:
        experiment: what is learned. out: its folder. dataset: demonstrations that are there already.
        workers: processes that generate and roll out.
    """

    experiment: Experiment
    out: Path
    dataset: Path | None = None
    workers: int = 1

    @property
    def _sight(self) -> Sight:
        return PERCEPTIONS[self.experiment.perception]

    @property
    def _is_strict(self) -> bool:
        return suite_of(self.experiment.tasks[0]) == STRICT

    @property
    def data(self) -> Path:
        """Where the demonstrations are."""
        return self.dataset or self.out / "data"

    def generate(self) -> Cost | None:
        """Make the demonstrations; None where they were given."""
        if self.dataset is not None:
            return None
        words = ["memobench", "generate", "--tasks", ",".join(self.experiment.tasks)]
        words += ["--referent", self.experiment.referent, "--episodes", str(self.experiment.episodes)]
        more = self.experiment.prompted_episodes
        words += [] if more is None else ["--prompted-episodes", str(more)]
        words += ["--suite", STRICT] if self._is_strict else []
        words += ["--perturb", "--out", str(self.data)]
        words += [] if self._sight.pictures else ["--no-images"]
        how = ["--workers", str(self.workers)]
        return run_once(words, self.out / "data.log", how=how, accept=(0, 1))

    def check_settings(self) -> None:
        """Refuse what training would, before anything is made; LeRobot's import is left out where nothing was added.

        Raises:
            MemobenchError: an unknown setting or value, named with the nearest known one.
        """
        from lerobot_memobench.run.arguments import read_settings
        from lerobot_memobench.run.training import take_training_words

        for arm in self.experiment.arms if self.experiment.settings else ():
            # All but the dataset, which is not there yet.
            told = [word for word in self.training_words(arm, 0)[2:] if not word.startswith("dataset=")]
            *_, words = take_training_words(split_words(told))
            read_settings("train", words)

    def training_words(self, arm: str, seed: int) -> list[str]:
        """Return the command that trains an arm's policy with one seed."""
        words = ["lerobot", "train", *SHARED, *self._sight.training]
        words += [f"dataset={self.data}", f"steps={self.experiment.steps}"]
        words += [f"seed={seed}", f"output_dir={self.policy(arm, seed)}"]
        return [*words, *self.experiment.settings, *self.experiment.arms[arm]]

    def train(self, arm: str, seed: int) -> Cost:
        """Train an arm's policy with one seed; as many at once as there are workers share the cores."""
        folder = self.policy(arm, seed)
        begun = self.checkpoint(arm, seed) / "train_config.json"
        going_on = ["lerobot", "train", f"config_path={begun}", "resume=true"] if begun.is_file() else None
        log = self.log("training", arm, seed)
        if going_on is None and not log.with_suffix(".json").is_file():
            shutil.rmtree(folder, ignore_errors=True)  # of an attempt that was killed before its first checkpoint
        return run_once(self.training_words(arm, seed), log, beside=self.workers, going_on=going_on)

    def evaluate(self, arm: str, seed: int) -> Cost:
        """Roll a trained policy out on the experiment's evaluation seeds."""
        words = ["lerobot", "eval", "env=memobench", f"policy={self.policy(arm, seed)}"]
        words += [*self._sight.evaluation, f"referent={self.experiment.referent}", "films=0"]
        words += [f"tasks={','.join(self.experiment.tasks)}"]
        words += [f"episodes={self.experiment.rollouts}", f"seed={self.experiment.first_seed}"]
        words += [f"output_dir={self.rollouts(arm, seed)}", "resume=true"]
        words += [f"suite={STRICT}"] if self._is_strict else []
        words += ["env.oracle_memory=true"] if "policy.oracle_memory=true" in self.experiment.arms[arm] else []
        how = [f"shards={self.workers}", f"workers={self.workers}"] if self.workers > 1 else []
        return run_once(words, self.log("evaluation", arm, seed), how=how)

    def policy(self, arm: str, seed: int) -> Path:
        """Return the folder of a training run."""
        return self.out / "policies" / name_of(arm, seed)

    def checkpoint(self, arm: str, seed: int) -> Path:
        """Return the folder of a training run's last checkpoint."""
        return self.policy(arm, seed) / "checkpoints" / "last" / "pretrained_model"

    def rollouts(self, arm: str, seed: int) -> Path:
        """Return the folder of an evaluation."""
        return self.out / "rollouts" / name_of(arm, seed)

    def log(self, part: str, arm: str, seed: int) -> Path:
        """Return the file of a command's output."""
        return self.out / part / f"{name_of(arm, seed)}.log"


def name_of(arm: str, seed: int) -> str:
    """Return what files of an arm and a training seed are called."""
    return f"{arm.replace(' ', '_')}-{seed}"
