"""Run many independent jobs, such as the making of one episode, and find them finished again: here, on Slurm, on Ray.

Whatever runs them, the result is the same, because a job depends on nothing but itself and knows from the disk whether
it is finished. So a killed run is continued by giving the same jobs again.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from inspect import signature
from multiprocessing.connection import wait
from pathlib import Path
from typing import Any, Protocol

from lerobot_memobench.datasets.staging import StagedEpisode, read_staged
from lerobot_memobench.errors import MemobenchError, nearest

EXECUTORS = ("processes", "local", "slurm", "ray")
"""``processes``: this package's own; the others are datatrove's."""

DATATROVE = {"local": "LocalPipelineExecutor", "slurm": "SlurmPipelineExecutor", "ray": "RayPipelineExecutor"}
SET_HERE = ("pipeline", "tasks", "workers", "depends")
"""Arguments of datatrove's executors that follow from the jobs and from ``workers``."""

EPISODES_PER_RANK = 10
"""Episodes that a datatrove task makes, one after another: neighbours share a compiled scene."""

POLL_SECONDS = 1.0


class Job(Protocol):
    """A piece of work. Pickled to other processes and machines, so ``folder`` is on a disk they share."""

    @property
    def folder(self) -> Path: ...

    @property
    def task_name(self) -> str: ...

    @property
    def seed(self) -> int: ...

    def run(self) -> None:
        """Leave the result, or the reason why there is none, in ``folder``."""

    def finished(self) -> bool:
        """Whether ``folder`` holds everything that the job had to leave there."""

    def failure(self) -> str | None:
        """Why a finished job has no result, or None."""


class StagedJob:
    """What jobs have in common that make one episode, complete or absent: two workers at the same one do no harm."""

    folder: Path

    def finished(self) -> bool:
        return read_staged(self.folder) is not None

    def failure(self) -> str | None:
        return staged(self).failure


@dataclass(frozen=True)
class Advance:
    """Told to the progress callback after each job: how many are finished, and the newest one's identity.

    ``found`` of those finished were so before this run began.
    """

    done: int
    total: int
    task_name: str
    seed: int
    failure: str | None
    found: int = 0


ProgressCallback = Callable[[Advance], None]


def run_jobs(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    progress: ProgressCallback | None = None,
    executor: str = "processes",
    options: Mapping[str, Any] | None = None,
    logs: Path,
    finish: Callable[[], Any] | None = None,
    jobs_per_rank: int = EPISODES_PER_RANK,
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
    done: set[Path] = set()
    lock = threading.Lock()

    def tell(job: Job) -> None:
        with lock:
            if job.folder in done:
                return
            done.add(job.folder)
            if progress is not None:
                progress(Advance(len(done), len(jobs), job.task_name, job.seed, job.failure(), found))

    waiting = [job for job in jobs if not job.finished()]
    found = len(jobs) - len(waiting)
    unfinished = {job.folder for job in waiting}
    for job in jobs:
        if job.folder not in unfinished:
            tell(job)
    if not waiting:
        return True
    if executor != "processes":
        return _run_by_datatrove(waiting, workers, executor, dict(options or {}), logs, finish, tell, jobs_per_rank)
    if workers == 1 or len(waiting) == 1:
        for job in waiting:
            job.run()
            tell(job)
        return True
    _run_in_processes(waiting, workers, tell)
    return True


def staged(job: StagedJob) -> StagedEpisode:
    """Return the finished episode of a job that has been run."""
    found = read_staged(job.folder)
    if found is None:
        raise MemobenchError(f"{job.folder} has vanished while the run was going on; run the command again")
    return found


def check_executor(executor: str, options: Mapping[str, Any] | None) -> None:
    """Raise when jobs cannot be run that way."""
    if executor not in EXECUTORS:
        raise MemobenchError(f"found executor {executor!r}, {nearest(executor, EXECUTORS)}")
    if executor == "processes":
        if options:
            raise MemobenchError(
                f"options {', '.join(options)} were given for executor 'processes', which takes none; name local, "
                "slurm or ray"
            )
        return
    try:
        import datatrove  # noqa: F401

        if executor == "ray":
            import ray  # noqa: F401
    except ImportError as error:
        raise MemobenchError(
            f"executor {executor!r} needs {error.name}, which is not installed: pip install "
            f"{'datatrove ray' if executor == 'ray' else 'datatrove'}"
        ) from None
    takes = [name for name in signature(_executor_class(executor)).parameters if name not in SET_HERE]
    for name in options or {}:
        if name not in takes:
            raise MemobenchError(f"found option {name!r} for executor {executor!r}, {nearest(name, takes)}")
    missing = [name for name in ("partition", "time") if executor == "slurm" and name not in (options or {})]
    if missing:
        raise MemobenchError(
            f"executor 'slurm' needs {' and '.join(missing)}: pass e.g. partition=cpu and time=08:00:00 as options"
        )


def _executor_class(executor: str) -> Callable[..., Any]:
    from datatrove import executor as executors

    found: Callable[..., Any] = getattr(executors, DATATROVE[executor])
    return found


# --- processes of this machine ------------------------------------------------------------------------------


def _run_in_processes(waiting: Sequence[Job], workers: int, tell: Callable[[Job], None]) -> None:
    with process_pool(min(workers, len(waiting))) as pool:
        futures: dict[Future[None], Job] = {pool.submit(_run, job): job for job in waiting}
        for future in as_completed(futures):
            future.result()
            tell(futures[future])


@contextlib.contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with the one that started them; what still waits when the context ends is dropped."""
    # Processes are spawned: a forked child would share GL contexts and threads with its parent.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    except BrokenProcessPool:
        raise MemobenchError(
            f"one of {workers} worker processes was killed, perhaps because memory ran out; run the same command "
            "again to go on from here, with fewer workers"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _run(job: Job) -> None:
    job.run()


def _begin_worker() -> None:
    """End this worker when the process that started it is gone, however it went; else it would wait on.

    Ctrl-C is the parent's to handle: the episode being made is finished, so that nothing is lost.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# --- datatrove ----------------------------------------------------------------------------------------------


def _run_by_datatrove(
    waiting: Sequence[Job],
    workers: int,
    executor: str,
    options: dict[str, Any],
    logs: Path,
    finish: Callable[[], Any] | None,
    tell: Callable[[Job], None],
    jobs_per_rank: int,
) -> bool:
    from lerobot_memobench.datasets.datatrove_steps import FinishStep, JobsStep

    # What is finished is known from the jobs' folders, better than from datatrove's list of completed tasks.
    common: dict[str, Any] = {"skip_completed": False, **options}
    ranks = max(min(workers, len(waiting)), -(-len(waiting) // jobs_per_rank))
    steps = [JobsStep(list(waiting))]
    pipeline = _executor_class(executor)
    if executor == "slurm":
        making = pipeline(
            steps,
            tasks=ranks,
            workers=workers,
            **{"job_name": "memobench", "logging_dir": str(logs / "make"), **common},
        )
        if finish is None:
            making.run()
        else:
            pipeline(
                [FinishStep(finish)],
                tasks=1,
                depends=making,
                **{"job_name": "memobench-finish", **common, "logging_dir": str(logs / "finish")},
            ).run()
        return False
    with _watching(waiting, tell):
        pipeline(steps, tasks=ranks, workers=workers, **{"logging_dir": str(logs / "make"), **common}).run()
    for job in waiting:
        tell(job)
    return True


@contextlib.contextmanager
def _watching(jobs: Sequence[Job], tell: Callable[[Job], None]) -> Iterator[None]:
    """Tell of finished jobs as they appear: datatrove has no such callback."""
    over = threading.Event()

    def watch() -> None:
        waiting = list(jobs)
        while not over.wait(POLL_SECONDS):
            for job in [job for job in waiting if job.finished()]:
                waiting.remove(job)
                tell(job)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
