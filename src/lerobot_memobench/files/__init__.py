"""How is a file written, so that nothing half-made is ever found, and where may a name from somebody's data lead?

And what is told when a disk has no room, or takes nothing.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

from lerobot_memobench.errors import MemobenchError

DRAFT = ".part."
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.EIO)
_IN_WORDS = re.compile(
    "|".join(os.strerror(number) for number in (*FULL, errno.EACCES, errno.EROFS, errno.EIO)), re.IGNORECASE
)
"""Libraries in C put what the system said into messages of errors of their own."""
LONGEST_NAME = 255
"""Bytes of a file's name that common file systems take."""


@contextlib.contextmanager
def draft_of(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a place to write to beside ``path``; it takes that name once the block has ended without an error.

    Readers see the earlier file or the whole new one, and processes that write the same file do not meet. The draft
    keeps the ending of ``path``, by which libraries choose a format.

    Args:
        durable: wait until the disk holds the content, so that a crash of the machine leaves no empty file either.
    """
    draft = path.with_name(f".{os.getpid()}-{secrets.token_hex(4)}{DRAFT}{path.name}")
    try:
        yield draft
        if durable:
            _to_disk(draft)
        os.replace(draft, path)
        if durable:
            _to_disk(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes, *, durable: bool = False) -> Path:
    """Write ``content`` (text as UTF-8) to ``path``, whole or not at all; return ``path``. See `draft_of`."""
    with draft_of(path, durable=durable) as draft:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def remove_drafts(folder: Path) -> None:
    """Remove what killed processes have left of `draft_of` in a folder that nobody else writes to."""
    for draft in folder.glob(f".*-*{DRAFT}*"):
        draft.unlink(missing_ok=True)


def file_name(text: object, what: str) -> str:
    """Return a name that came out of data, if it names a file in a folder and nothing anywhere else.

    Args:
        text: the name as it was read. what: what it is, for the message: ``the task's name in demo.hdf5``.

    Raises:
        MemobenchError: it is no text, is empty, begins with a dot, or holds a separator or a control character.
    """
    if (
        not isinstance(text, str)
        or not text
        or text.startswith(".")
        or not text.isprintable()
        or set(text) & set('/\\:*?"<>|')
        or len(text.encode()) > LONGEST_NAME
    ):
        raise MemobenchError(
            f"{what} is {str(text)[:80]!r}, which names no file; expected letters, digits, spaces and _-,.+ alone"
        )
    return text


def file_hash(path: Path) -> str:
    """Return the sha256 (hex) of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def disk_refusal(error: BaseException) -> str | None:
    """Return what a disk answered to writing, as the system puts it, where that led to an error; None where not."""
    current: BaseException | None = error
    for _ in range(20):  # an error may be its own cause's cause
        if current is None:
            return None
        number = getattr(current, "errno", None)
        if number in (*FULL, *CLOSED):
            return os.strerror(number)
        found = _IN_WORDS.search(str(current)) if not isinstance(current, MemobenchError) else None
        if found:
            return found[0]
        current = current.__cause__ or (None if current.__suppress_context__ else current.__context__)
    return None


@contextlib.contextmanager
def telling_of_the_disk(out: Path, kept: str = "") -> Iterator[None]:
    """Turn what the disk answers to writing below ``out`` into one sentence.

    Args:
        out: the folder that is written. kept: ends the sentence: what is there, and how to go on.

    Raises:
        MemobenchError: the disk is full, or takes nothing.
    """
    try:
        yield
    except MemobenchError:
        raise
    except Exception as error:  # OSError, and whatever libraries in C make of it
        refusal = disk_refusal(error)
        named = getattr(error, "filename", None)
        if refusal is None or (named is not None and not _is_of(Path(os.fsdecode(named)), out)):
            raise
        raise MemobenchError(
            f"{out} cannot be written ({refusal}; {in_words(free_bytes(out))} are free there): make room, or name "
            f"another folder{kept and '; ' + kept}"
        ) from error


def _is_of(path: Path, out: Path) -> bool:
    """Whether a path is what is written, or on the way to it; not what is read."""
    path, out = path.absolute(), out.absolute()
    return path.is_relative_to(out) or out.is_relative_to(path)


def in_words(size: float) -> str:
    """Return bytes as people say them: ``45.8 GiB``."""
    number, units = float(size), ["B", "KiB", "MiB", "GiB", "TiB"]
    while number >= 1024 and len(units) > 1:
        number /= 1024
        del units[0]
    return f"{number:.1f} {units[0]}" if units[0] != "B" else f"{number:.0f} B"


def free_bytes(folder: Path) -> int:
    """Return how much may still be written to a folder, or to what it will lie in."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def _to_disk(path: Path) -> None:
    if sys.platform == "win32":
        return  # it opens no folders, and flushes no file that is open for reading
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
