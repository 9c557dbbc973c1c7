"""Processes of this machine: workers that run jobs, the start and end of a command, and locks on folders and files."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import multiprocessing
import os
import select
import signal
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path
from types import FrameType
from typing import Protocol

import psutil
from filelock import lock_descriptor

from lerobot_memobench.errors import MemobenchError, came_through, unsupported_system
from lerobot_memobench.io import choose_caches, private_folder
from lerobot_memobench.jobs.threads import ACTING, use_threads

# --- workers that run jobs ---


class Job(Protocol):
    """A piece of work, such as an episode to generate. It is pickled to worker processes."""

    @property
    def task_name(self) -> str:
        """Name in messages and progress."""

    @property
    def seed(self) -> int:
        """Number among the jobs of that name."""

    def run(self) -> None:
        """Write the result, or the reason for its absence, to the disk."""

    def finished(self) -> bool:
        """Return whether the job has run."""

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


class WorkerKilledError(MemobenchError):
    """A worker process was killed; commands end with status 1."""

    exit_code = 1


def run_jobs(jobs: Sequence[Job], *, workers: int = 1, progress: ProgressCallback | None = None) -> None:
    """Run the jobs that are not finished yet, ``workers`` at a time; the same call continues a killed run.

    ``progress`` is called after each job, first for those that were finished before.
    """
    finished: list[Job] = []
    waiting: list[Job] = []
    for job in jobs:
        (finished if job.finished() else waiting).append(job)
    done = 0

    def count(job: Job) -> None:
        nonlocal done
        done += 1
        if progress is not None:
            progress(Advance(done, len(jobs), job.task_name, job.seed, job.failure(), len(finished)))

    for job in finished:
        count(job)
    if workers == 1 or len(waiting) <= 1:
        for job in waiting:
            job.run()
            count(job)
        return
    with process_pool(min(workers, len(waiting))) as pool:
        futures = {pool.submit(job.run): job for job in waiting}
        for future in as_completed(futures):
            future.result()
            count(futures[future])


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
    """Prepare a worker process, which ends when its parent ends, even if the parent is killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent handles Ctrl-C, and waits for the jobs that run
    use_threads(ACTING)  # there are as many workers as cores
    name = multiprocessing.current_process().name  # SpawnProcess-3
    os.environ["MEMOBENCH_WORKER"] = name.rpartition("-")[2]  # workers render on several GPUs in turn
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


# --- the start of a command ---


LONGEST_TEMPORARY = 72
"""Longest path of the temporary folder, bytes: addresses of sockets have 107, and multiprocessing appends 32."""
SHORT_FOLDERS = ("/tmp", "/var/tmp", "/dev/shm")


def prepare_process() -> None:
    """Prepare a command for streams, temporary folder and caches unlike those of a developer's machine.

    Child processes inherit the last two. A temporary folder with a long path that cannot be shortened is refused.
    """
    _open_streams()
    choose_caches()
    if sys.platform != "win32" and len(os.fsencode(tempfile.gettempdir())) > LONGEST_TEMPORARY:
        _shorten_temporary_folder(tempfile.gettempdir())


def _open_streams() -> None:
    """Open closed standard streams on the null device, and print letters outside the output's encoding as escapes."""
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            try:
                os.fstat(number)
            except OSError:  # else the next file that is opened would have the number, and receive the output
                os.dup2(os.open(os.devnull, os.O_RDWR), number)
                os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False, encoding="utf-8"))
        elif number and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _shorten_temporary_folder(folder: str) -> None:
    """Name a long temporary folder by a short link: data loaders and worker processes place their sockets in it."""
    for shared in SHORT_FOLDERS:
        try:
            link = private_folder(shared) / hashlib.sha256(os.fsencode(folder)).hexdigest()[:8]
            if not link.is_symlink():
                link.symlink_to(folder)
        except FileExistsError:
            pass  # another process of this user was faster
        except OSError:
            continue
        os.environ["TMPDIR"] = tempfile.tempdir = str(link)
        return
    raise MemobenchError(
        f"the temporary folder {folder} has a longer path than sockets allow ({LONGEST_TEMPORARY} bytes), and none of "
        f"{', '.join(SHORT_FOLDERS)} can be written; set TMPDIR to a folder with a shorter path"
    )


def reader_has_left() -> bool:
    """Return whether the program that reads the standard output has ended; if so, drop further output."""
    try:
        poll = select.poll()
        poll.register(1, 0)
        if not any(event & select.POLLERR for _, event in poll.poll(0)):
            return False
    except (AttributeError, OSError, ValueError):
        return False
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    return True


# --- the end of a command ---


@contextlib.contextmanager
def adding_resume_hint(program: str, how: Callable[[], str]) -> Iterator[None]:
    """Print advice on continuing if SIGTERM terminates this process in the block, or if a worker is killed.

    SIGTERM (a job is preempted, its time is up) ends this process and its descendants at once: all files on the disk
    are complete. The signal keeps its handler in other threads than the main one, and if it has another handler.
    ``how`` returns the advice; an inner block replaces an outer one.
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


def _is_dead_worker(error: BaseException) -> bool:
    """Return whether multiprocessing or a data loader of torch raised an error because a process was killed."""
    if isinstance(error, RuntimeError):
        return str(error).startswith("DataLoader worker (pid")
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(frame.f_globals.get("__name__") == Connection.__module__ for frame in frames)


def _kill_descendants() -> None:
    """Kill the descendants of this process, except multiprocessing's resource tracker, which cleans up."""
    seen: set[psutil.Process] = set()
    ours = []
    while new := set(psutil.Process().children(recursive=True)) - seen:
        seen |= new
        for process in new:
            with contextlib.suppress(psutil.Error):
                if not any("resource_tracker" in word for word in process.cmdline()):
                    ours.append(process)
                    process.suspend()  # so that it starts no other process
    for process in ours:
        with contextlib.suppress(psutil.Error):
            process.kill()


# --- locks ---


NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)
"""Errors of `flock` on disks without locks, as some clusters mount them."""


class HeldError(MemobenchError):
    """Another run is writing to a folder."""


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Lock ``out`` for one run at a time; take it before anything in ``out`` is written or removed.

    The lock is on the folder or file ``staging`` itself, so no lock file remains. `HeldError`: another run holds it.
    """
    if sys.platform == "win32" and staging.is_dir():  # Windows cannot lock folders
        raise MemobenchError(unsupported_system())
    descriptor = os.open(staging, os.O_RDONLY if staging.is_dir() else os.O_RDWR)
    try:
        # The run that held the lock may have removed or replaced the folder since it was opened.
        is_locked = _lock(descriptor) and staging.exists() and os.path.samestat(os.fstat(descriptor), staging.stat())
        if not is_locked:
            raise HeldError(f"another run is writing to {out}; wait for it to end or name another folder")
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; return whether no other process holds the lock."""
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
