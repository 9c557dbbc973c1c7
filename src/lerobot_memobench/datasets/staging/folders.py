"""Folders that are whole or not there, and what killed workers leave of them."""

from __future__ import annotations

import os
import re
import shutil
import socket
from collections.abc import Iterable
from pathlib import Path

STAGING = ".staging"
"""Folder of a run within its destination."""
TEMPORARY = ".tmp-"


def clean_temporaries(folder: Path) -> None:
    """Remove what this machine's killed workers left in the folder of episodes; others may still be working."""
    for path in folder.glob(f"{TEMPORARY}{_host()}-*"):
        pid = path.name.removeprefix(f"{TEMPORARY}{_host()}-").split("-")[0]
        if not (pid.isdigit() and _alive(int(pid))):
            shutil.rmtree(path, ignore_errors=True)


def temporary_folder(folder: Path) -> Path:
    """Make and return an empty folder beside ``folder``, to be renamed to it when it is whole."""
    temporary = folder.parent / f"{TEMPORARY}{_host()}-{os.getpid()}-{folder.name}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    return temporary


def flush_to_disk(paths: Iterable[Path]) -> None:
    """Wait until the disk holds files, or the entries of folders."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return pid != os.getpid()  # what this process left behind earlier is rubbish too
