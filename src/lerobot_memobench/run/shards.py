"""``lerobot eval … shards=8``: the parts of an evaluation as jobs of their own, then merged.

A part is the same command with ``shard=i/n resume=true`` in a process of its own, here or on another machine that sees
the same folder; so a killed part is gone on with, and a finished one is left alone.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import ProgressCallback
from lerobot_memobench.jobs.running import run_jobs
from lerobot_memobench.jobs.slurm import Needs, Slurm
from lerobot_memobench.jobs.threads import LARGE, sharing
from lerobot_memobench.policies.lerobot_config import parameters_of
from lerobot_memobench.protocol import SEALED
from lerobot_memobench.run.card import card_of
from lerobot_memobench.run.merging import SHARDS, merge_held
from lerobot_memobench.run.plan import EvaluationPlan, Shard
from lerobot_memobench.run.run import EvaluationReport, Tell, check_folder, check_new, logged, made, resumed_card

LOGS = "logs"


@dataclass(frozen=True)
class ShardJob:
    """One part of an evaluation, as a job.

    Attributes:
        program: arguments of Python that start ``lerobot`` in a process which ends when its standard input does.
        flags: LeRobot's, without folders.
        out: folder of the evaluation.
        episodes: (task, episode) of those that the part consists of.
        directory: where relative paths are looked up.
        beside: parts that run at once on the machine, this one included.
    """

    program: tuple[str, ...]
    flags: tuple[str, ...]
    shard: Shard
    out: Path
    episodes: frozenset[tuple[str, int]]
    referent: str
    directory: Path
    beside: int = 1

    @property
    def folder(self) -> Path:
        """Folder of the part's log."""
        return self.out / self.shard.folder

    @property
    def task_name(self) -> str:
        """What the job is called where progress is told."""
        return f"part {self.shard}"

    @property
    def seed(self) -> int:
        """The part's number: jobs are told apart by it."""
        return self.shard.number

    @property
    def arguments(self) -> list[str]:
        """The command line of the part, after ``lerobot``."""
        return ["eval", f"output_dir={self.out}", f"shard={self.shard}", "resume=true", *self.flags]

    @property
    def messages(self) -> Path:
        """File of what the part's process prints."""
        return self.out / LOGS / f"{self.shard.folder}.log"

    def finished(self) -> bool:
        """Whether all episodes of the part are in its log."""
        return self.episodes <= logged(self.folder, self.referent)

    def failure(self) -> str | None:
        """Return None: a part that cannot be run raises."""
        return None

    def run(self) -> None:
        """Run the part in a process of its own, which ends when this one does.

        Raises:
            MemobenchError: it failed, with its own last word.
        """
        self.messages.parent.mkdir(parents=True, exist_ok=True)
        with self.messages.open("ab") as file:
            process = subprocess.Popen(
                [sys.executable, *self.program, *self.arguments],
                cwd=self.directory,
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=file,
                env=sharing(self.beside),
            )
            try:
                status = process.wait()
            except BaseException:
                process.kill()
                process.wait()
                raise
        if status:
            raise MemobenchError(
                f"{self.task_name} ended with {self._reason(status)} (see {self.messages}); the same command "
                "with resume=true goes on"
            )

    def _reason(self, status: int) -> str:
        """Return the sentence with which the process ended, its status where it left none."""
        lines = self.messages.read_text(errors="replace").strip().splitlines()
        said = [line.removeprefix("lerobot: ") for line in lines if line.startswith("lerobot: ")]
        return said[-1] if said else f"status {status}"


def plan_shards(plan: EvaluationPlan, program: Sequence[str], tell: Tell) -> list[ShardJob]:
    """Return a job for each part of an evaluation.

    Args:
        program: see `ShardJob`.
        tell: told what matters and stops nothing.

    Raises:
        MemobenchError: the number of parts or what is in the folders forbids it.
    """
    options, grid, out = plan.options, plan.grid, plan.output.absolute()
    if options.shards > len(grid.cells()):
        raise MemobenchError(
            f"shards={options.shards} is more than the {len(grid.cells())} batches that the evaluation consists of; "
            "ask for fewer"
        )
    jobs = [
        ShardJob(
            program=tuple(program),
            flags=(*plan.settings.words, *_part_options(plan)),
            shard=shard,
            out=out,
            episodes=frozenset(episode for cell in grid.cells(shard) for episode in grid.episodes(cell)),
            referent=plan.environment.referent,
            directory=Path.cwd(),
            beside=1 if options.slurm is not None else min(options.workers or options.shards, options.shards),
        )
        for shard in (Shard(k + 1, options.shards) for k in range(options.shards))
    ]
    _check_folders(plan, out, jobs, tell)
    return jobs


def _part_options(plan: EvaluationPlan) -> Iterator[str]:
    """Yield the run options that each part has, too."""
    if plan.split == SEALED:
        yield f"split={SEALED}"
    if plan.options.memory_reads:
        yield "memory_reads=true"


def _check_folders(plan: EvaluationPlan, out: Path, jobs: Sequence[ShardJob], tell: Tell) -> None:
    """Refuse to mix an evaluation with another one in its folder or in those of its parts."""
    check_folder(out)
    if plan.options.resume:
        card = card_of(plan)
        for folder in (out, *(job.folder for job in jobs)):
            resumed_card(folder, card, tell)
    else:
        for folder in (out, *out.glob(SHARDS)):
            check_new(folder)


def slurm_of(plan: EvaluationPlan) -> Slurm | None:
    """Return how the parts are submitted to Slurm, None where they run here.

    A large policy requests a GPU, and memory for its weights twice.
    """
    options, device = plan.options, plan.settings.policy.get("device")
    if options.slurm is None:
        return None
    parameters = parameters_of(plan.policy_path) or 0 if plan.policy_path is not None else 0
    on_gpu = device.startswith("cuda") if device else parameters >= LARGE
    needs = Needs(cores=2, memory_gb=8 + 2 * 4 * parameters // 10**9, gpus=int(on_gpu))
    return Slurm(options.slurm, needs, plan.output.absolute() / LOGS, jobs_per_member=1)


def run_shards(
    plan: EvaluationPlan,
    jobs: Sequence[ShardJob],
    progress: ProgressCallback,
    finish: Callable[[Path, Sequence[Path]], Any],
) -> EvaluationReport | None:
    """Run all parts, at once or some at a time, and merge them; None where they have been handed to Slurm.

    Args:
        finish: what Slurm's last job calls with the evaluation's folder and those of its parts. It is pickled.
    """
    options, out, folders = plan.options, plan.output.absolute(), [job.folder for job in jobs]
    with made(out):
        complete = run_jobs(
            jobs,
            workers=options.workers or len(jobs),
            progress=progress,
            slurm=slurm_of(plan),
            finish=partial(finish, out, folders),
        )
        return merge_held(out, [folder for folder in folders if has_log(folder)]) if complete else None
