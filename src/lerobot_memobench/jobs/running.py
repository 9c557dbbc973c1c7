"""Run many independent jobs, such as episodes to generate, in processes of this machine.

Finished jobs are found on the disk, so running the same jobs again continues a killed run.
"""

from __future__ import annotations

from collections.abc import Sequence

from lerobot_memobench.jobs.processes import Advance, Job, ProgressCallback, run_in_processes


def run_jobs(jobs: Sequence[Job], *, workers: int = 1, progress: ProgressCallback | None = None) -> None:
    """Run the jobs that are not finished yet.

    Args:
        workers: number of jobs at a time.
        progress: called after each job; first for jobs that were finished before.

    Raises:
        MemobenchError: a worker was killed.
    """
    over = [job.finished() for job in jobs]
    finished = [job for job, is_over in zip(jobs, over, strict=True) if is_over]
    waiting = [job for job, is_over in zip(jobs, over, strict=True) if not is_over]
    done = 0

    def count(job: Job) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(Advance(done, len(jobs), job.task_name, job.seed, job.failure(), len(finished)))

    for job in finished:
        count(job)
    if workers > 1 and len(waiting) > 1:
        run_in_processes(waiting, workers, count)
    else:
        for job in waiting:
            job.run()
            count(job)
