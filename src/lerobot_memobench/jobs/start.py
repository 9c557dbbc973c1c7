"""Prepare a process for output, temporary folders and caches that differ from those of a developer's machine."""

from __future__ import annotations

import hashlib
import os
import select
import sys
import tempfile

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import choose_caches, private_folder

LONGEST_TEMPORARY = 72
"""Longest path of the temporary folder, bytes: addresses of sockets have 107, and multiprocessing appends 32."""
SHORT_FOLDERS = ("/tmp", "/var/tmp", "/dev/shm")


def prepare_process() -> None:
    """Prepare streams, temporary folder and caches of a command; its child processes inherit the last two.

    Raises:
        MemobenchError: the path of the temporary folder is too long, and cannot be shortened.
    """
    _open_streams()
    choose_caches()
    if sys.platform != "win32":
        _shorten_temporary_folder()


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


def _shorten_temporary_folder() -> None:
    """Name a long temporary folder by a short link: data loaders and worker processes place their sockets in it."""
    folder = tempfile.gettempdir()
    if len(os.fsencode(folder)) <= LONGEST_TEMPORARY:
        return
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
