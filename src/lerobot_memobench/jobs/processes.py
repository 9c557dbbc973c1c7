"""Processes of this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.job import Job
from lerobot_memobench.jobs.threads import ACTING, use_threads


def run_in_processes(jobs: Sequence[Job], workers: int, tell: Callable[[Job], None]) -> None:
    """Run the jobs, ``workers`` at a time; ``tell`` of each in the order in which they end."""
    with process_pool(min(workers, len(jobs))) as pool:
        futures: dict[Future[None], Job] = {pool.submit(_run, job): job for job in jobs}
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

    Ctrl-C is the parent's to handle: the job at hand is finished, so that nothing is lost.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(ACTING)  # one of as many as there are cores
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
