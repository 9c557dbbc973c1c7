"""``lerobot eval … shards=8 executor=slurm``: the parts of an evaluation as jobs of their own, then merged.

A part is the same command with ``shard=i/n resume=true`` in a process of its own, here or on another machine that sees
the same folder; so a killed part is gone on with, and a finished one is left alone.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from lerobot_memobench.cli import preflight
from lerobot_memobench.cli.console import console, counting
from lerobot_memobench.cli.evaluation import Evaluation, describe, logged
from lerobot_memobench.cli.merging import merge_and_report
from lerobot_memobench.cli.orders import Shard
from lerobot_memobench.envs.episode_log import has_log
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.executors import check_executor
from lerobot_memobench.jobs.job import Advance
from lerobot_memobench.jobs.running import run_jobs

LOGS = "logs"
CHILD = "from lerobot_memobench.cli.shards import child; child()"


@dataclass(frozen=True)
class ShardJob:
    """One part of an evaluation.

    Attributes:
        flags: LeRobot's, without folders.
        out: folder of the evaluation.
        episodes: (task, episode) of those that the part consists of.
        directory: where relative paths are looked up.
    """

    flags: tuple[str, ...]
    shard: Shard
    out: Path
    episodes: frozenset[tuple[str, int]]
    referent: str
    directory: Path

    @property
    def folder(self) -> Path:
        return self.out / self.shard.folder

    @property
    def task_name(self) -> str:
        return f"part {self.shard}"

    @property
    def seed(self) -> int:
        return self.shard.number

    def finished(self) -> bool:
        return self.episodes <= logged(self.folder, self.referent)

    def failure(self) -> str | None:
        return None

    def run(self) -> None:
        """Run the part in a process of its own, which ends when this one does. What it prints goes to a log file."""
        words = ["eval", f"output_dir={self.out}", f"shard={self.shard}", "resume=true", *self.flags]
        messages = self.out / LOGS / f"{self.shard.folder}.log"
        messages.parent.mkdir(parents=True, exist_ok=True)
        with messages.open("ab") as file:
            process = subprocess.Popen(
                [sys.executable, "-c", CHILD, *words],
                cwd=self.directory,
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=file,
            )
            try:
                status = process.wait()
            except BaseException:
                process.kill()
                process.wait()
                raise
        if status:
            lines = messages.read_text(errors="replace").strip().splitlines()
            reason = next((line for line in reversed(lines) if line.startswith("lerobot: ")), f"status {status}")
            raise MemobenchError(
                f"{self.task_name} ended with {reason.removeprefix('lerobot: ')} (see {messages}); the same command "
                "with resume=true goes on"
            )


def child() -> None:
    """Be a part's process: ``lerobot`` with the words of the command line, ended when standard input closes."""
    from lerobot_memobench.cli.lerobot import main

    source = sys.stdin.fileno()

    def watch() -> None:
        while os.read(source, 1):
            pass
        os._exit(1)  # the process that wanted the part is gone

    threading.Thread(target=watch, daemon=True).start()
    sys.exit(main(sys.argv[1:]))


def run_shards(evaluation: Evaluation) -> int:
    """Run all parts, at once or some at a time, and merge them; return the exit status."""
    orders, grid, out = evaluation.orders, evaluation.grid, evaluation.output.absolute()
    assert grid is not None
    check_executor(orders.executor, orders.executor_options)
    cells = grid.cells()
    if orders.shards > len(cells):
        raise MemobenchError(
            f"shards={orders.shards} is more than the {len(cells)} batches that the evaluation consists of; ask for "
            "fewer"
        )
    shards = [Shard(k + 1, orders.shards) for k in range(orders.shards)]
    jobs = [
        ShardJob(
            tuple(evaluation.flags),
            shard,
            out,
            frozenset(episode for cell in grid.cells(shard) for episode in grid.episodes(cell)),
            evaluation.environment.referent,
            Path.cwd(),
        )
        for shard in shards
    ]
    preflight.check_folder(out)
    if orders.resume:
        card = describe(evaluation)
        for folder in (out, *(job.folder for job in jobs)):
            preflight.check_resumed(folder, card)
    else:
        for folder in (out, *out.glob("shard-*-of-*")):
            preflight.check_output(folder)
    screen = console()
    with counting(screen, "parts", len(jobs)) as count:

        def advance(news: Advance) -> None:
            count(news.done, news.total, news.task_name, found=news.found)

        folders = [job.folder for job in jobs]
        complete = run_jobs(
            jobs,
            workers=orders.workers or len(jobs),
            progress=advance,
            executor=orders.executor,
            options=orders.executor_options,
            logs=out / LOGS,
            finish=partial(merge_and_report, out, folders),
            jobs_per_rank=1,
        )
    if not complete:
        screen.print(f"jobs are submitted; the last of them merges the parts in {out}", soft_wrap=True)
        return 0
    return merge_and_report(out, [folder for folder in folders if has_log(folder)])
