"""Jobs, the processes of this machine that run them, termination by a signal, and locks on folders and files."""

from __future__ import annotations

import contextlib
import errno
import functools
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

from lerobot_memobench.errors import MemobenchError, came_through, unsupported_system
from lerobot_memobench.jobs.threads import ACTING, use_threads


class Job(Protocol):
    """A piece of work. It is pickled to worker processes."""

    @property
    def folder(self) -> Path:
        """Folder of the result, unique to the job."""

    @property
    def task_name(self) -> str:
        """Name in messages and progress."""

    @property
    def seed(self) -> int:
        """Number among the jobs of that name."""

    def run(self) -> None:
        """Write the result, or the reason for its absence, to ``folder``."""

    def finished(self) -> bool:
        """Return whether ``folder`` is complete."""

    def failure(self) -> str | None:
        """Return why a finished job has no result, or None."""


@dataclass(frozen=True)
class Advance:
    """Progress after a job: ``done`` of ``total`` jobs, ``found`` of them before this run, and the newest job."""

    done: int
    total: int
    task_name: str
    seed: int
    failure: str | None
    found: int = 0


ProgressCallback = Callable[[Advance], None]


def run_in_processes(jobs: Sequence[Job], workers: int, done: Callable[[Job], None]) -> None:
    """Run the jobs, ``workers`` at a time; call ``done`` with each job when it ends."""
    with process_pool(min(workers, len(jobs))) as pool:
        futures: dict[Future[None], Job] = {pool.submit(job.run): job for job in jobs}
        for future in as_completed(futures):
            future.result()
            done(futures[future])


class WorkerKilledError(MemobenchError):
    """A worker process was killed; commands end with status 1."""

    exit_code = 1


def _is_dead_worker(error: BaseException) -> bool:
    """Return whether multiprocessing or a data loader of torch raised an error because a process was killed."""
    if isinstance(error, RuntimeError):
        return str(error).startswith("DataLoader worker (pid")
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(frame.f_globals.get("__name__") == Connection.__module__ for frame in frames)


@contextlib.contextmanager
def process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Yield a pool of processes that end with this process; waiting jobs are cancelled at the end of the context."""
    # Processes are spawned, because a forked child has the locks of its parent's threads without the threads.
    pool = ProcessPoolExecutor(workers, mp_context=multiprocessing.get_context("spawn"), initializer=_begin_worker)
    try:
        yield pool
    except BrokenProcessPool:
        raise WorkerKilledError(
            f"one of {workers} worker processes was killed, usually because memory ran out; run the same command "
            "again with fewer workers to continue"
        ) from None
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Prepare a worker process: it ends when its parent ends, even if the parent is killed.

    The worker ignores Ctrl-C, which the parent handles, and finishes its job.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    use_threads(ACTING)  # there are as many workers as cores
    name = multiprocessing.current_process().name  # SpawnProcess-3
    os.environ["MEMOBENCH_WORKER"] = name.rpartition("-")[2]  # workers render on several GPUs in turn
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def adding_resume_hint(program: str, how: Callable[[], str]) -> Iterator[None]:
    """Print advice on continuing if SIGTERM terminates this process in the block, or if a worker is killed.

    SIGTERM (a job is preempted, its time is up) ends this process and its descendants at once: all files on the disk
    are complete. The signal keeps its handler in other threads than the main one, and if it has another handler.

    Args:
        program: name of the command. how: returns the advice. An inner block replaces an outer one.

    Raises:
        WorkerKilledError: a worker process was killed.
    """
    own = os.getpid()

    def end(number: int, frame: FrameType | None) -> None:
        if os.getpid() != own:  # a process that was forked from this one
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
            return
        try:  # not sys.stderr: the signal may interrupt a write to it
            os.write(2, f"{program}: ended by SIGTERM; {how()}\n".encode())
        finally:
            _kill_descendants()
            os._exit(128 + number)  # as shells report a signal

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
    """Kill the descendants of this process; each is suspended first, so that it starts no other process."""
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
    """Return the descendants of this process, except multiprocessing's resource tracker, which cleans up."""
    descendants = set()
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            if not any("resource_tracker" in word for word in process.cmdline()):
                descendants.add(process)
    return descendants


class HeldError(MemobenchError):
    """Another run is writing to a folder."""


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Lock ``out`` for one run at a time.

    The lock is on the folder or file ``staging`` itself, so no lock file remains. Take it before anything in ``out`` is
    written or removed.

    Raises:
        HeldError: another run holds the lock.
        MemobenchError: the system is Windows, which cannot lock folders.
    """
    if sys.platform == "win32" and staging.is_dir():
        raise MemobenchError(unsupported_system())
    descriptor = os.open(staging, os.O_RDONLY if staging.is_dir() else os.O_RDWR)
    try:
        if not (_lock(descriptor) and _is_at(staging, descriptor)):
            raise HeldError(f"another run is writing to {out}; wait for it to end or name another folder")
        yield
    finally:
        os.close(descriptor)


NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of `flock` on disks without locks, as some clusters mount them."""


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; return whether no other process holds the lock. A disk may have no locks."""
    try:
        return lock_descriptor(descriptor, blocking=False)
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        note_missing_locks(os.strerror(error.errno))
        return True


@functools.cache
def note_missing_locks(reason: str) -> None:
    """Print once that the disk has no locks."""
    print(
        f"note: the disk cannot lock files ({reason}), so two commands could write to one folder at once: start one "
        "command per folder",
        file=sys.stderr,
    )


def lock_refusal(error: BaseException) -> str | None:
    """Return a sentence on an error of Hugging Face's caches on a disk without locks, None for other errors."""
    if not (isinstance(error, OSError) and error.errno in NO_LOCKS and came_through(error, "filelock")):
        return None
    return (
        f"the disk of Hugging Face's caches cannot lock files ({error.strerror}): set HF_HOME, or "
        "HF_DATASETS_CACHE alone, to a folder on another disk, such as one in /tmp"
    )


def _is_at(folder: Path, descriptor: int) -> bool:
    """Return whether an open folder was neither removed nor replaced by the run that held the lock."""
    try:
        return os.path.samestat(os.fstat(descriptor), folder.stat())
    except FileNotFoundError:
        return False
