"""One run at a time in a folder, or one after another at a file."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from lerobot_memobench.errors import MemobenchError


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Let one run at a time write to ``out``.

    The lock is the kernel's, is held on the folder ``staging`` itself, leaves nothing behind and ends with the process.

    Raises:
        MemobenchError: another run holds it.
    """
    import fcntl

    descriptor = os.open(staging, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise MemobenchError(
                f"another run is writing to {out}; wait for it to end or name another folder"
            ) from None
        yield
    finally:
        os.close(descriptor)


@contextlib.contextmanager
def taking_turns(path: Path, wait: Callable[[], None] = lambda: None) -> Iterator[None]:
    """Hold a lock file; whoever comes next, on this machine, waits, and calls ``wait`` first. A kill releases it."""
    import fcntl

    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            wait()
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
