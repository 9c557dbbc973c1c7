"""What keeps a run in a folder apart from other runs: a lock, and the request that it answers."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.staging import LEROBOT, write_json
from lerobot_memobench.errors import MemobenchError

REQUEST_FILE = "request.json"


@contextlib.contextmanager
def locked(staging: Path, out: Path) -> Iterator[None]:
    """Let one run at a time write to ``out``.

    The lock is the kernel's, is held on the folder ``staging`` itself, leaves nothing behind and ends with the process.
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


def check_request(staging: Path, request: dict[str, Any], out: Path, advice: str) -> None:
    """Remember the request in an unfinished run's folder; raise where it was another one."""
    path = staging / REQUEST_FILE
    try:
        earlier = json.loads(path.read_text())
    except FileNotFoundError:
        write_json(request, path)
        return
    compare_requests(earlier, request, f"{out} holds an unfinished run", advice)


def compare_requests(earlier: dict[str, Any], request: dict[str, Any], what: str, advice: str) -> None:
    """Raise with the first thing that was asked for differently."""
    earlier = {"formats": [LEROBOT], **earlier}  # written before there were two
    for key, value in request.items():
        if earlier.get(key) != value:
            raise MemobenchError(f"{what} with {key}={earlier.get(key)!r}, now {value!r} was asked for; {advice}")
