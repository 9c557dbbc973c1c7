"""How is a file written, so that nothing half-made is ever found, and where may a name from somebody's data lead?"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import sys
from collections.abc import Iterator
from pathlib import Path

from lerobot_memobench.errors import MemobenchError

DRAFT = ".part."
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


def _to_disk(path: Path) -> None:
    if sys.platform == "win32":
        return  # it opens no folders, and flushes no file that is open for reading
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
