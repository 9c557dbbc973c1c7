"""Submit jobs to Slurm: an array that shares them out, and a last job that completes the result.

Both run ``python -m lerobot_memobench.jobs.slurm PART LOGS``, which reads the pickled jobs from the folder ``LOGS``. A
member of the array that was preempted is requeued and skips the jobs that are finished.
"""

from __future__ import annotations

import os
import pickle
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import Job, check_finished, saying_how_to_go_on
from lerobot_memobench.jobs.threads import ACTING, use_threads

MAKE, FINISH = "make", "finish"
"""Parts of a submission: the array, and the last job."""
JOBS_FILE = "jobs.pickle"
JOBS_PER_MEMBER = 10
"""Jobs that a member of the array runs, one after another: neighbours share a compiled scene."""
OPTION = re.compile(r"--[a-z][a-z0-9-]*(=.+)?")
PREEMPTED = "finished work stays; the job goes on when Slurm requeues it or when the same command is given again"
GPU_OPTIONS = ("--gres", "--gpus")
"""Beginnings of the options by which a user asks for GPUs."""


def read_options(text: str) -> tuple[str, ...]:
    """Return the options of sbatch in a text such as ``--partition=gpu --time=8:00:00``.

    Raises:
        MemobenchError: a word is no long option.
    """
    words = tuple(shlex.split(text))
    wrong = next((word for word in words if not OPTION.fullmatch(word)), None)
    if wrong is not None or not words:
        raise MemobenchError(
            f"found {wrong or text!r} among the options of sbatch, expected long options with their values, such as "
            "--partition=gpu --time=8:00:00"
        )
    return words


@dataclass(frozen=True)
class Needs:
    """Resources of one job, unless its user's options name others: cores, memory (GB) and GPUs."""

    cores: int = 2
    memory_gb: int = 8
    gpus: int = 0


@dataclass(frozen=True)
class Slurm:
    """How jobs are submitted.

    Attributes:
        options: of sbatch, from the user (`read_options`).
        needs: resources of one job.
        logs: folder for the pickled jobs and for what they print; on a disk that all machines share.
        jobs_per_member: jobs that a member of the array runs, one after another.
    """

    options: tuple[str, ...]
    needs: Needs
    logs: Path
    jobs_per_member: int = JOBS_PER_MEMBER

    @property
    def requested(self) -> tuple[str, ...]:
        """Options of sbatch for one job: the needs, where the user's options leave them open, and those options."""
        needs = [f"--cpus-per-task={self.needs.cores}"]  # of an option given twice sbatch takes the last
        if not any(option.startswith("--mem") for option in self.options):
            needs.append(f"--mem={self.needs.memory_gb}G")
        if self.needs.gpus and not any(option.startswith(GPU_OPTIONS) for option in self.options):
            needs.append(f"--gpus-per-task={self.needs.gpus}")
        return (*needs, *self.options)

    @property
    def summary(self) -> str:
        """A sentence on what each job requests."""
        return f"each job requests {' '.join(self.requested)}; slurm= takes other options of sbatch"

    def submit(self, jobs: Sequence[Job], workers: int, finish: Callable[[], Any] | None) -> None:
        """Submit the jobs, ``workers`` members at a time, and after them a job that calls ``finish``.

        Raises:
            MemobenchError: sbatch is missing or refuses them.
        """
        members = max(min(workers, len(jobs)), -(-len(jobs) // self.jobs_per_member))
        self.logs.mkdir(parents=True, exist_ok=True)
        (self.logs / JOBS_FILE).write_bytes(pickle.dumps((list(jobs), members, finish)))
        array = self._sbatch(MAKE, f"--array=0-{members - 1}%{workers}", *self.requested)
        if finish is not None:
            # afterany: the last job names the members that have failed, instead of waiting for them for ever.
            without_gpu = [option for option in self.requested if not option.startswith(GPU_OPTIONS)]
            self._sbatch(FINISH, f"--dependency=afterany:{array}", *without_gpu)

    def _sbatch(self, part: str, *options: str) -> str:
        """Submit a part of the work and return Slurm's number of it."""
        logs = self.logs.absolute()
        command = shlex.join([sys.executable, "-m", __name__, part, str(logs)])
        own = [f"--job-name=memobench-{part}", f"--output={logs}/{part}-%j.log", "--open-mode=append", "--requeue"]
        words = ["sbatch", "--parsable", *own, *options, f"--wrap={command}"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, check=True)
        except FileNotFoundError:
            raise MemobenchError("this machine has no sbatch; run the command on a login node of the cluster") from None
        except subprocess.CalledProcessError as error:
            said = " ".join(error.stderr.split())
            raise MemobenchError(f"sbatch refused the jobs ({said}); correct its options") from None
        return done.stdout.strip().partition(";")[0]


def run_part(part: str, logs: Path) -> None:
    """Run one member's jobs, or complete the result.

    Raises:
        MemobenchError: a job failed, or, in the last part, jobs ended without a result.
    """
    jobs, members, finish = pickle.loads((logs / JOBS_FILE).read_bytes())  # noqa: S301 - `Slurm.submit` wrote it
    if part == FINISH:
        check_finished(jobs, logs)
        finish()
        return
    member = int(os.environ["SLURM_ARRAY_TASK_ID"])
    for job in jobs[member * len(jobs) // members : (member + 1) * len(jobs) // members]:
        if not job.finished():
            job.run()


if __name__ == "__main__":
    use_threads(ACTING)
    try:
        with saying_how_to_go_on("memobench", lambda: PREEMPTED):
            run_part(sys.argv[1], Path(sys.argv[2]))
    except MemobenchError as error:
        sys.exit(f"memobench: {error}")
