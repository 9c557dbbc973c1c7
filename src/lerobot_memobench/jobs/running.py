"""Run many independent jobs, such as the making of one episode, and find them finished again: here, on Slurm, on Ray.

Whatever runs them, the result is the same, because a job depends on nothing but itself and knows from the disk whether
it is finished. So a killed run is continued by giving the same jobs again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.jobs.executors import Datatrove, check_executor
from lerobot_memobench.jobs.job import Advance, Job, ProgressCallback
from lerobot_memobench.jobs.processes import run_in_processes

JOBS_PER_RANK = 10
"""Jobs that a datatrove task runs, one after another: neighbours share what is costly to set up, such as a scene."""


def run_jobs(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    progress: ProgressCallback | None = None,
    executor: str = "processes",
    options: Mapping[str, Any] | None = None,
    logs: Path,
    finish: Callable[[], Any] | None = None,
    jobs_per_rank: int = JOBS_PER_RANK,
) -> bool:
    """Run the jobs that are not finished yet; tell ``progress`` of every one, old or new.

    Args:
        jobs: what to do.
        workers: how many run at a time.
        progress: called after each job (on Slurm, for those that were finished before).
        executor: one of ``EXECUTORS``.
        options: further arguments of datatrove's executor, such as Slurm's ``partition`` and ``time``.
        logs: folder for datatrove's logs.
        finish: what is to be done when all jobs are; called only on Slurm, in a job of its own.
        jobs_per_rank: how many a datatrove task runs, one after another.

    Returns:
        Whether all jobs are finished; False when they have been handed to Slurm.

    Raises:
        MemobenchError: a worker was killed, or the executor is unknown, not installed or misses an option.
    """
    check_executor(executor, options)
    finished = [job.finished() for job in jobs]
    waiting = [job for job, over in zip(jobs, finished, strict=True) if not over]
    tell = _Teller(len(jobs), sum(finished), progress)
    for job, over in zip(jobs, finished, strict=True):
        if over:
            tell(job)
    if not waiting:
        return True
    if executor != "processes":
        datatrove = Datatrove(executor, workers, logs, jobs_per_rank, options or {})
        if executor == "slurm":
            datatrove.submit(waiting, finish)
            return False
        datatrove.run(waiting, tell)
    elif workers == 1 or len(waiting) == 1:
        for job in waiting:
            job.run()
            tell(job)
    else:
        run_in_processes(waiting, workers, tell)
    return True


class _Teller:
    """Tells the progress callback of each finished job once, whichever thread notices it first."""

    def __init__(self, total: int, found: int, progress: ProgressCallback | None) -> None:
        self._total, self._found, self._progress = total, found, progress
        self._told: set[Path] = set()
        self._lock = threading.Lock()

    def __call__(self, job: Job) -> None:
        with self._lock:
            if job.folder in self._told:
                return
            self._told.add(job.folder)
            if self._progress is not None:
                done = len(self._told)
                self._progress(Advance(done, self._total, job.task_name, job.seed, job.failure(), self._found))
