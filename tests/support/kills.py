"""SIGKILL at a chosen call, as the kernel or a cluster ends a process, without cleanup."""

from __future__ import annotations

import hashlib
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any


def killed_at(holder: Any, name: str, call: int | str, work: Callable[[], object]) -> None:
    """Do ``work`` in a child that gets SIGKILL before the ``call``-th call of ``holder.name``.

    A ``call`` that is a text is the first one whose last argument is a path that ends so.
    A child that hangs, which a fork of a process with threads may, gets SIGALRM instead.

    Raises:
        AssertionError: the work ended before that.
    """
    pid = os.fork()
    if pid:
        ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        assert ended in (-signal.SIGKILL, -signal.SIGALRM), f"{name} was not called as {call} ({ended})"
        return
    try:
        signal.alarm(300)
        inner, count = getattr(holder, name), 0

        def fatal(*args: Any, **settings: Any) -> Any:
            nonlocal count
            count += 1
            if count == call if isinstance(call, int) else str(args[-1]).endswith(call):
                os.kill(os.getpid(), signal.SIGKILL)
            return inner(*args, **settings)

        setattr(holder, name, fatal)
        work()
        os._exit(0)
    except BaseException:
        os._exit(1)


def hashes(root: Path) -> dict[str, str]:
    """Return the hash of each file below a folder, but for locks."""
    files = [path for path in sorted(root.rglob("*")) if path.is_file() and path.suffix != ".lock"]
    return {path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}
