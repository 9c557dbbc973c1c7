"""Jobs, the processes of this machine that run them, their end by a signal, and locks on folders and files."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Protocol

import psutil
from filelock import lock_descriptor

from lerobot_memobench.errors import MemobenchError, unsupported_system
from lerobot_memobench.jobs.threads import ACTING, use_threads


class Job(Protocol):
    """A piece of work. Pickled to other processes and machines, so ``folder`` is on a disk they share."""

    @property
    def folder(self) -> Path:
        """Where the result goes; no two jobs have the same."""

    @property
    def task_name(self) -> str:
        """Name in messages and progress."""

    @property
    def seed(self) -> int:
        """Its number among those of that name."""

    def run(self) -> None:
        """Leave the result, or the reason why there is none, in ``folder``."""

    def finished(self) -> bool:
        """Whether ``folder`` holds everything that the job had to leave there."""

    def failure(self) -> str | None:
        """Why a finished job has no result, or None."""


@dataclass(frozen=True)
class Advance:
    """Progress after a job: how many of ``total`` are done, ``found`` of them before this run, and the newest job."""

    done: int
    total: int
    task_name: str
    seed: int
    failure: str | None
    found: int = 0


ProgressCallback = Callable[[Advance], None]


MOST_NAMED = 5


def check_finished(jobs: Sequence[Job], logs: Path) -> None:
    """Refuse to go on with jobs that ended without a result, as a killed one does.

    Raises:
        MemobenchError: naming them, and how to go on.
    """
    failed = [job.folder.name for job in jobs if not job.finished()]
    if not failed:
        return
    names = ", ".join(failed[:MOST_NAMED]) + (f" and {len(failed) - MOST_NAMED} more" if failed[MOST_NAMED:] else "")
    raise MemobenchError(
        f"{len(failed)} of {len(jobs)} jobs ended without a result ({names}); "
        f"see {logs}, then run the same command again (an evaluation's with resume=true), which runs these alone"
    )


def run_in_processes(jobs: Sequence[Job], workers: int, done: Callable[[Job], None]) -> None:
    """Run the jobs, ``workers`` at a time; call ``done`` with each in the order in which they end."""
    with process_pool(min(workers, len(jobs))) as pool:
        futures: dict[Future[None], Job] = {pool.submit(job.run): job for job in jobs}
        for future in as_completed(futures):
            future.result()
            done(futures[future])


class WorkerKilledError(MemobenchError):
    """A process that this one had started was killed; commands end with status 1."""

    exit_code = 1


def _is_dead_worker(error: BaseException) -> bool:
    """Return whether an error is how multiprocessing, or a loader of torch, reports a process that is gone."""
    if isinstance(error, RuntimeError):
        return str(error).startswith("DataLoader worker (pid")
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(frame.f_globals.get("__name__") == Connection.__module__ for frame in frames)


@contextlib.contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Processes that end with the one that started them; what still waits when the context ends is dropped."""
    # Processes are spawned: a forked child would have locks of its parent's threads, but not the threads.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    except BrokenProcessPool:
        raise WorkerKilledError(
            f"one of {workers} worker processes was killed, usually because memory ran out; run the same command "
            "again to go on from here, with fewer workers"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """End this worker when the process that started it is gone, however it went; else it would wait on.

    Ctrl-C is the parent's to handle: the job at hand is finished, so that nothing is lost.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(ACTING)  # one of as many as there are cores
    name = multiprocessing.current_process().name  # SpawnProcess-3
    os.environ["MEMOBENCH_WORKER"] = name.rpartition("-")[2]  # workers draw on several GPUs in turn, where there are
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def saying_how_to_go_on(program: str, how: Callable[[], str]) -> Iterator[None]:
    """Print how to go on where SIGTERM ends the process in this block, or a worker of it is killed.

    SIGTERM (a job is preempted, its time is up) ends this process and all that it has started. Nothing is waited for:
    the files on the disk are whole, as after any kill. In another thread than the main one, and where the signal has
    another handler, the signal is left alone.

    Args:
        program: name of the command. how: returns how to go on. An inner block replaces an outer one.

    Raises:
        WorkerKilledError: a worker process was killed.
    """
    own = os.getpid()

    def end(number: int, frame: FrameType | None) -> None:
        if os.getpid() != own:  # a process that was forked from this one
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        try:  # no stream: the signal may have come while one was being written to
            os.write(2, f"{program}: ended by SIGTERM; {how()}\n".encode())
        finally:
            _kill_descendants()
            os._exit(128 + number)

    before = signal.getsignal(signal.SIGTERM) if threading.current_thread() is threading.main_thread() else None
    ours = before is signal.SIG_DFL or getattr(before, "__qualname__", None) == end.__qualname__
    if ours:
        signal.signal(signal.SIGTERM, end)
    try:
        yield
    except (EOFError, ConnectionError, RuntimeError) as error:
        if not _is_dead_worker(error):
            raise
        traceback.clear_frames(error.__traceback__)  # CPython 3.12.1 crashes where it collects a pipe's buffer in them
        raise WorkerKilledError(
            "a worker process was killed, usually because memory ran out; choose a smaller batch_size, or fewer workers"
            f"; {how()}"
        ) from error
    finally:
        if ours:
            signal.signal(signal.SIGTERM, before)


def _kill_descendants() -> None:
    """Kill every process that descends from this one; each is stopped first, so that none starts another meanwhile."""
    stopped: set[psutil.Process] = set()
    while new := _descendants() - stopped:
        for process in new:
            with contextlib.suppress(psutil.Error):
                process.suspend()
        stopped |= new
    for process in stopped:
        with contextlib.suppress(psutil.Error):
            process.kill()


def _descendants() -> set[psutil.Process]:
    """Return the descendants of this process, but for multiprocessing's resource tracker, which tidies up."""
    found = set()
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if not any("resource_tracker" in word for word in process.cmdline()):
                found.add(process)
    return found


class HeldError(MemobenchError):
    """Another run is writing to a folder."""


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Let one run at a time write to ``out``.

    The lock is held on the folder, or file, ``staging`` itself and leaves nothing behind. Take it before anything in
    ``out`` is written or removed.

    Raises:
        HeldError: another run holds it.
        MemobenchError: the system is Windows, which locks no folders.
    """
    if sys.platform == "win32" and staging.is_dir():
        raise MemobenchError(unsupported_system())
    descriptor = os.open(staging, os.O_RDONLY if staging.is_dir() else os.O_RDWR)
    try:
        if not (lock_descriptor(descriptor, blocking=False) and _is_at(staging, descriptor)):
            raise HeldError(f"another run is writing to {out}; wait for it to end or name another folder")
        yield
    finally:
        os.close(descriptor)


def _is_at(folder: Path, descriptor: int) -> bool:
    """Return whether an open folder has not been removed, or replaced, by the run that held it until now."""
    try:
        return os.path.samestat(os.fstat(descriptor), folder.stat())
    except FileNotFoundError:
        return False


@contextlib.contextmanager
def taking_turns(path: Path, wait: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold a lock file, which stays; whoever comes next, on this machine, calls ``wait``, then waits.

    A kill releases it.
    """
    with path.open("w") as file:
        if not lock_descriptor(file.fileno(), blocking=False):
            wait()
            lock_descriptor(file.fileno())
        yield
