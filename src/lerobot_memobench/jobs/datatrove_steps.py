"""The project's jobs as steps of a datatrove pipeline, which knows how to reach Slurm and Ray."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from datatrove.pipeline.base import PipelineStep

from lerobot_memobench.jobs.processes import Job, saying_how_to_go_on

PREEMPTED = (
    "what is finished stays, and the job goes on when Slurm requeues it, or when the "
    "command that submitted it is given again (an evaluation's with resume=true)"
)


class JobsStep(PipelineStep):
    """Run the jobs of one rank: neighbours in the list, which may share what is costly to set up."""

    name = "jobs"
    type = "MEMOBench"

    def __init__(self, jobs: list[Job]) -> None:
        super().__init__()
        self.jobs = jobs

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> Iterator[Any]:
        """Do what is not finished yet of every ``world_size``-th part of the list."""
        yield from data or ()
        count = len(self.jobs)
        with saying_how_to_go_on("memobench", lambda: PREEMPTED):
            for job in self.jobs[rank * count // world_size : (rank + 1) * count // world_size]:
                if not job.finished():
                    with self.track_time("job"):
                        job.run()
                    self.stat_update("jobs")


class FinishStep(PipelineStep):
    """Do what remains once all jobs are finished; a job of its own, depending on theirs."""

    name = "finish"
    type = "MEMOBench"

    def __init__(self, finish: Callable[[], Any]) -> None:
        super().__init__()
        self.finish = finish

    def run(self, data: Any = None, rank: int = 0, world_size: int = 1) -> Iterator[Any]:
        """Call it, in the first rank."""
        yield from data or ()
        if rank == 0:
            self.finish()
