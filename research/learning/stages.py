"""The three parts of an experiment, each a command of the product: demonstrations, policies, rollouts.

A command is run as a user would; its output is in a file and its cost known.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, NotRequired, TypedDict

from lerobot_memobench.datasets.lerobot_format.layout import INFO_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import read_json, write_file
from lerobot_memobench.jobs.threads import sharing
from lerobot_memobench.run.arguments import split_arguments
from lerobot_memobench.tasks.catalogue import suite_of
from lerobot_memobench.tasks.task import STRICT
from research.learning.experiments import PERCEPTIONS, Experiment, Perception

MODULES = {"lerobot": "lerobot_memobench.cli.lerobot", "memobench": "lerobot_memobench.cli.memobench"}


@dataclass(frozen=True)
class Cost:
    """What a command took, over all its attempts: seconds on the clock, and of processors in those not killed."""

    wall_s: float
    cpu_s: float

    def __add__(self, other: Cost) -> Cost:
        """Return both together."""
        return Cost(self.wall_s + other.wall_s, self.cpu_s + other.cpu_s)


class Kept(TypedDict):
    """What is kept of a command, in a file beside its log.

    Attributes:
        words: the command. ended: whether it ended well. wall_s, cpu_s: see `Cost`.
        began: when the attempt that runs, or was killed, began; seconds since 1970.
    """

    words: list[str]
    ended: bool
    wall_s: float
    cpu_s: float
    began: NotRequired[float]


def run_once(
    words: Sequence[str],
    log: Path,
    *,
    how: Sequence[str] = (),
    beside: int = 1,
    accept: Sequence[int] = (0,),
    going_on: Sequence[str] | None = None,
    makes: Path | None = None,
    proof: Path | None = None,
) -> Cost:
    """Run ``lerobot …`` or ``memobench …`` unless it has ended well before; return what it took.

    Its output goes to ``log``, its cost and its words beside it.

    Args:
        how: more words, which decide nothing that comes out: in how many processes it is done.
        beside: commands that run at once, this one included; they share the cores (`jobs.threads`).
        accept: exit statuses of a command that did its work.
        going_on: what is run instead, to finish what an earlier attempt has begun.
        makes: a folder that the command refuses to find; what an attempt left of it, that cannot be gone on with, is
            removed.
        proof: what it leaves behind when it did its work, where a status that is accepted does not tell.

    Raises:
        MemobenchError: the command failed, is running, or another one stands beside the log.
    """
    kept, spent = log.with_suffix(".json"), Cost(0.0, 0.0)
    if told := kept_of(log):
        if told["words"] != list(words):
            raise MemobenchError(
                f"{kept} is of another command; name another --out, or remove the file and what the command has made"
            )
        spent = Cost(told["wall_s"], told["cpu_s"])
        if told["ended"]:
            return spent
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as output:
        try:
            fcntl.flock(output, fcntl.LOCK_EX | fcntl.LOCK_NB)  # the command inherits it, and holds it to its end
        except BlockingIOError:
            raise MemobenchError(f"a command from before still writes {log}; wait for its end, or end it") from None
        if told and "began" in told:  # and never said what it took: it was killed, just after its last output
            spent += Cost(round(max(log.stat().st_mtime - told["began"], 0.0), 1), 0.0)
        if makes is not None and going_on is None:
            shutil.rmtree(makes, ignore_errors=True)
        # So that what is killed is gone on with by the same command alone, and is not forgotten.
        _keep(kept, words, False, spent, began=time.time())
        status, took = _run(going_on or [*words, *how], output, sharing(beside))
    well = status in accept and (proof is None or proof.exists())
    _keep(kept, words, well, spent + took)
    if not well:
        *_, last = log.read_text(errors="replace").rstrip().splitlines() or [""]
        raise MemobenchError(f"`{' '.join(words)}` ended with status {status} ({last[:400]}); see {log}")
    return spent + took


def _keep(kept: Path, words: Sequence[str], ended: bool, spent: Cost, **more: float) -> None:
    write_file(kept, json.dumps({"words": list(words), "ended": ended, **asdict(spent), **more}, indent=1))


def kept_of(log: Path) -> Kept | None:
    """Return what is kept of the command of a log; None where it has not been begun."""
    try:
        kept: Kept = read_json(log.with_suffix(".json"), Kept, "remove it, and the command is run again")
    except FileNotFoundError:
        return None
    return kept


def ended(log: Path) -> bool:
    """Return whether the command of a log has ended well."""
    told = kept_of(log)
    return told is not None and told["ended"]


def train_once(words: Sequence[str], log: Path, policy: Path, *, beside: int = 1) -> Cost:
    """Run ``lerobot train …`` into the folder ``policy``, or go on from its last checkpoint; see `run_once`.

    Raises:
        MemobenchError: as `run_once`; or a checkpoint is there, and nothing says by which command.
    """
    from lerobot_memobench.training.resume import TRAIN_CONFIG, last_checkpoint

    try:
        begun = last_checkpoint(policy) / TRAIN_CONFIG
    except MemobenchError:
        return run_once(words, log, beside=beside, makes=policy)
    if kept_of(log) is None:
        raise MemobenchError(
            f"{policy} holds a checkpoint, and {log.with_suffix('.json')}, which says by which command, is gone; "
            "remove the folder, and it is trained anew"
        )
    return run_once(words, log, beside=beside, going_on=["lerobot", "train", f"config_path={begun}", "resume=true"])


def check_training(words: Sequence[str]) -> None:
    """Refuse what ``lerobot train …`` would, before it is run; its dataset need not be there yet.

    Raises:
        MemobenchError: an unknown setting or value, named with the nearest known one.
    """
    from lerobot_memobench.run.arguments import read_arguments
    from lerobot_memobench.training.command import take_training_options

    told = [word for word in words[2:] if not word.startswith("dataset=")]
    *_, rest = take_training_options(split_arguments(told))
    read_arguments("train", rest)


def _run(words: Sequence[str], output: IO[str], environment: Mapping[str, str]) -> tuple[int, Cost]:
    """Run a command to its end; return its exit status and what it and its own processes took."""
    started = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", MODULES[words[0]], *words[1:]],
        stdout=output,
        stderr=subprocess.STDOUT,
        env=environment,
    )
    try:
        _, status, used = os.wait4(process.pid, 0)
    except BaseException:
        process.terminate()
        raise
    process.returncode = os.waitstatus_to_exitcode(status)
    wall = time.monotonic() - started
    return process.returncode, Cost(round(wall, 1), round(used.ru_utime + used.ru_stime, 1))


Costs = dict[str, list[Cost | None]]
"""Part of an experiment -> what each of its commands took; None for one that was not needed."""


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
    def _perception(self) -> Perception:
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
        words += [] if self._perception.pictures else ["--no-images"]
        how = ["--workers", str(self.workers)]
        return run_once(words, self.out / "data.log", how=how, accept=(0, 1), proof=self.data / INFO_FILE)

    def check_settings(self) -> None:
        """Refuse what training would, before anything is made; LeRobot's import is left out where nothing was added.

        Raises:
            MemobenchError: an unknown setting or value, named with the nearest known one.
        """
        for arm in self.experiment.arms if self.experiment.settings else ():
            check_training(self.training_words(arm, 0))

    def training_words(self, arm: str, seed: int) -> list[str]:
        """Return the command that trains an arm's policy with one seed."""
        words = ["lerobot", "train", *SHARED, *self._perception.training]
        words += [f"dataset={self.data}", f"steps={self.experiment.steps}"]
        words += [f"seed={seed}", f"output_dir={self.policy(arm, seed)}"]
        return [*words, *self.experiment.settings, *self.experiment.arms[arm]]

    def train(self, arm: str, seed: int) -> Cost:
        """Train an arm's policy with one seed; as many at once as there are workers share the cores."""
        words, log = self.training_words(arm, seed), self.log("training", arm, seed)
        return train_once(words, log, self.policy(arm, seed), beside=self.workers)

    def evaluate(self, arm: str, seed: int) -> Cost:
        """Roll a trained policy out on the experiment's evaluation seeds."""
        words = ["lerobot", "eval", "env=memobench", f"policy={self.policy(arm, seed)}"]
        words += [*self._perception.evaluation, f"referent={self.experiment.referent}", "videos=0"]
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
