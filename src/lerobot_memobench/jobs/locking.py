"""One run at a time in a folder, or one after another at a file.

The locks are the kernel's: they end with the process, however it ends, and are never taken for ones left behind.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

from filelock import lock_descriptor

from lerobot_memobench.errors import MemobenchError, unsupported_system


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Let one run at a time write to ``out``.

    The lock is held on the folder ``staging`` itself and leaves nothing behind.

    Raises:
        MemobenchError: another run holds it, or the system is Windows, which locks no folders.
    """
    if sys.platform == "win32":
        raise MemobenchError(unsupported_system())
    descriptor = os.open(staging, os.O_RDONLY)
    try:
        if not lock_descriptor(descriptor, blocking=False):
            raise MemobenchError(f"another run is writing to {out}; wait for it to end or name another folder")
        yield
    finally:
        os.close(descriptor)


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
