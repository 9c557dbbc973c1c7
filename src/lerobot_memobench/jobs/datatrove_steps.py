"""The project's jobs as steps of a datatrove pipeline, which knows how to reach Slurm and Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from datatrove.pipeline.base import PipelineStep

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import Job, check_finished, run_in_processes, saying_how_to_go_on

PREEMPTED = (
    "what is finished stays, and the job goes on when Slurm requeues it, or when the "
    "command that submitted it is given again (an evaluation's with resume=true)"
)


class JobsStep(PipelineStep):
    """Run the jobs of one rank: neighbours in the list, which may share what is costly to set up.

    Args:
        apart: in a process of their own, whose kill is noticed: datatrove's pools wait for a killed member for ever.
    """

    name = "jobs"
    type = "MEMOBench"

    def __init__(self, jobs: list[Job], apart: bool = False) -> None:
        super().__init__()
        self.jobs, self.apart = jobs, apart

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> Iterator[Any]:
        """Do what is not finished yet of every ``world_size``-th part of the list."""
        yield from data or ()
        count = len(self.jobs)
        with saying_how_to_go_on("memobench", lambda: PREEMPTED):
            mine = self.jobs[rank * count // world_size : (rank + 1) * count // world_size]
            waiting = [job for job in mine if not job.finished()]
            if self.apart and waiting:
                run_in_processes(waiting, 1, lambda job: self.stat_update("jobs"))
                return
            for job in waiting:
                with self.track_time("job"):
                    job.run()
                self.stat_update("jobs")


class FinishStep(PipelineStep):
    """Do what remains once all jobs have ended; a job of its own, depending on theirs."""

    name = "finish"
    type = "MEMOBench"

    def __init__(self, jobs: list[Job], logs: Path, finish: Callable[[], Any]) -> None:
        super().__init__()
        self.jobs, self.logs, self.finish = jobs, logs, finish

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> Iterator[Any]:
        """Call it, in the first rank; end with status 1 and a sentence where a job has failed."""
        yield from data or ()
        if rank == 0:
            try:
                check_finished(self.jobs, self.logs)
                self.finish()
            except MemobenchError as error:
                raise SystemExit(f"memobench: {error}") from None
