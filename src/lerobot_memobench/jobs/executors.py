"""What else can run jobs than this package itself: datatrove's executors, which know how to reach Slurm and Ray."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.job import Job

EXECUTORS = ("processes", "local", "slurm", "ray")
"""``processes``: this package's own; the others are datatrove's."""

DATATROVE = {"local": "LocalPipelineExecutor", "slurm": "SlurmPipelineExecutor", "ray": "RayPipelineExecutor"}
SET_HERE = ("pipeline", "tasks", "workers", "depends")
"""Arguments of datatrove's executors that follow from the jobs and from ``workers``."""

POLL_SECONDS = 1.0


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
    _check_installed(executor)
    takes = [name for name in signature(_executor_class(executor)).parameters if name not in SET_HERE]
    for name in options or {}:
        if name not in takes:
            raise MemobenchError(f"found option {name!r} for executor {executor!r}, {nearest(name, takes)}")
    missing = [name for name in ("partition", "time") if executor == "slurm" and name not in (options or {})]
    if missing:
        raise MemobenchError(
            f"executor 'slurm' needs {' and '.join(missing)}: pass e.g. partition=cpu and time=08:00:00 as options"
        )


def _check_installed(executor: str) -> None:
    try:
        import datatrove  # noqa: F401

        if executor == "ray":
            import ray  # noqa: F401
    except ImportError as error:
        raise MemobenchError(
            f"executor {executor!r} needs {error.name}, which is not installed: pip install "
            f"{'datatrove ray' if executor == 'ray' else 'datatrove'}"
        ) from None


def _executor_class(executor: str) -> Callable[..., Any]:
    from datatrove import executor as executors

    found: Callable[..., Any] = getattr(executors, DATATROVE[executor])
    return found


@dataclass(frozen=True)
class Datatrove:
    """One of datatrove's executors, and what it is told.

    Attributes:
        executor: one of ``EXECUTORS`` but ``processes``.
        workers: jobs at a time.
        logs: folder for its logs.
        jobs_per_rank: jobs that one of its tasks runs, one after another.
        options: its further arguments.
    """

    executor: str
    workers: int
    logs: Path
    jobs_per_rank: int
    options: Mapping[str, Any] = field(default_factory=dict)

    def run(self, jobs: Sequence[Job], tell: Callable[[Job], None]) -> None:
        """Run the jobs here or on Ray; ``tell`` of each."""
        with _watching(jobs, tell):
            self._making(jobs).run()
        for job in jobs:
            tell(job)

    def submit(self, jobs: Sequence[Job], finish: Callable[[], Any] | None) -> None:
        """Hand the jobs to Slurm, and with them a last one that calls ``finish`` when they are done."""
        making = self._making(jobs, job_name="memobench")
        if finish is None:
            making.run()
            return
        from lerobot_memobench.jobs.datatrove_steps import FinishStep

        settings = {"job_name": "memobench-finish", **self._common, "logging_dir": str(self.logs / "finish")}
        _executor_class(self.executor)([FinishStep(finish)], tasks=1, depends=making, **settings).run()

    def _making(self, jobs: Sequence[Job], **settings: Any) -> Any:
        from lerobot_memobench.jobs.datatrove_steps import JobsStep

        ranks = max(min(self.workers, len(jobs)), -(-len(jobs) // self.jobs_per_rank))
        settings = {**settings, "logging_dir": str(self.logs / "make"), **self._common}
        return _executor_class(self.executor)([JobsStep(list(jobs))], tasks=ranks, workers=self.workers, **settings)

    @property
    def _common(self) -> dict[str, Any]:
        # What is finished is known from the jobs' folders, better than from datatrove's list of completed tasks.
        return {"skip_completed": False, **self.options}


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
