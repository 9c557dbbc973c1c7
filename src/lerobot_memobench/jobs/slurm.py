"""Submit jobs to Slurm: an array that runs them, and a last job that completes the result.

Both run ``python -m lerobot_memobench.jobs.slurm PART LOGS``, which reads the pickled jobs from the folder ``LOGS``. A
preempted member of the array is requeued and skips finished jobs.
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
from lerobot_memobench.jobs.processes import Job, adding_resume_hint, check_finished
from lerobot_memobench.jobs.start import prepare_process
from lerobot_memobench.jobs.threads import ACTING, use_threads

MAKE, FINISH = "make", "finish"
"""Parts of a submission: the array, and the last job."""
JOBS_FILE = "jobs.pickle"
JOBS_PER_MEMBER = 10
"""Jobs of a member of the array; consecutive jobs share a compiled scene."""
OPTION = re.compile(r"--[a-z][a-z0-9-]*(=.+)?")
PREEMPTED = "finished jobs are kept; the others run when Slurm requeues this job, or run the same command again"
GPU_OPTIONS = ("--gres", "--gpus")
"""Prefixes of the options that request GPUs."""


def read_options(text: str) -> tuple[str, ...]:
    """Return the options of sbatch in a text such as ``--partition=gpu --time=8:00:00``.

    Raises:
        MemobenchError: a word is not a long option.
    """
    words = tuple(shlex.split(text))
    wrong = next((word for word in words if not OPTION.fullmatch(word)), None)
    if wrong is not None or not words:
        raise MemobenchError(
            f"found {wrong or text!r} in the options of sbatch; expected long options with their values, such as "
            "--partition=gpu --time=8:00:00"
        )
    return words


@dataclass(frozen=True)
class Needs:
    """Default resources of a job: cores, memory (GB) and GPUs."""

    cores: int = 2
    memory_gb: int = 8
    gpus: int = 0


@dataclass(frozen=True)
class Slurm:
    """How jobs are submitted.

    Attributes:
        options: of sbatch, from the user (`read_options`).
        needs: default resources of a job.
        logs: folder for the pickled jobs and their output, on a disk that all machines share.
        jobs_per_member: jobs of a member of the array.
    """

    options: tuple[str, ...]
    needs: Needs
    logs: Path
    jobs_per_member: int = JOBS_PER_MEMBER

    @property
    def requested(self) -> tuple[str, ...]:
        """Options of sbatch for a job: the user's options, and the default resources for the rest."""
        needs = [f"--cpus-per-task={self.needs.cores}"]  # sbatch uses the last one of equal options
        if not any(option.startswith("--mem") for option in self.options):
            needs.append(f"--mem={self.needs.memory_gb}G")
        if self.needs.gpus and not any(option.startswith(GPU_OPTIONS) for option in self.options):
            needs.append(f"--gpus-per-task={self.needs.gpus}")
        return (*needs, *self.options)

    @property
    def summary(self) -> str:
        """A sentence with the requested resources."""
        return f"each job requests {' '.join(self.requested)}; slurm= takes other options of sbatch"

    def submit(self, jobs: Sequence[Job], workers: int, finish: Callable[[], Any] | None) -> None:
        """Submit the jobs, ``workers`` members at a time, and a last job that calls ``finish``.

        Raises:
            MemobenchError: sbatch is missing or refuses the jobs.
        """
        members = max(min(workers, len(jobs)), -(-len(jobs) // self.jobs_per_member))
        self.logs.mkdir(parents=True, exist_ok=True)
        (self.logs / JOBS_FILE).write_bytes(pickle.dumps((list(jobs), members, finish)))
        array = self._sbatch(MAKE, f"--array=0-{members - 1}%{workers}", *self.requested)
        if finish is not None:
            # afterany: the last job reports failed members instead of waiting forever.
            without_gpu = [option for option in self.requested if not option.startswith(GPU_OPTIONS)]
            self._sbatch(FINISH, f"--dependency=afterany:{array}", *without_gpu)

    def _sbatch(self, part: str, *options: str) -> str:
        """Submit a part of the work and return its number."""
        logs = self.logs.absolute()
        command = shlex.join([sys.executable, "-m", __name__, part, str(logs)])
        own = [f"--job-name=memobench-{part}", f"--output={logs}/{part}-%j.log", "--open-mode=append", "--requeue"]
        words = ["sbatch", "--parsable", *own, *options, f"--wrap={command}"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, check=True)
        except FileNotFoundError:
            raise MemobenchError("this machine has no sbatch; run the command on a login node of the cluster") from None
        except subprocess.CalledProcessError as error:
            reason = " ".join(error.stderr.split())
            raise MemobenchError(f"sbatch refused the jobs ({reason}); correct its options") from None
        return done.stdout.strip().partition(";")[0]


def run_part(part: str, logs: Path) -> None:
    """Run the jobs of a member of the array, or complete the result.

    Raises:
        MemobenchError: a job failed; in the last part, jobs ended without a result.
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
        prepare_process()
        with adding_resume_hint("memobench", lambda: PREEMPTED):
            run_part(sys.argv[1], Path(sys.argv[2]))
    except MemobenchError as error:
        sys.exit(f"memobench: {error}")
