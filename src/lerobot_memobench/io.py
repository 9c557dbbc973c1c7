"""Write files atomically, check file names from data, and report disk errors."""

from __future__ import annotations

import contextlib
import errno
import functools
import getpass
import hashlib
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from lerobot_memobench.errors import MemobenchError, chain, in_words

DRAFT = ".part."
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.EIO)
_IN_WORDS = re.compile(
    "|".join(os.strerror(number) for number in (*FULL, errno.EACCES, errno.EROFS, errno.EIO)), re.IGNORECASE
)
"""Libraries in C include the system's message in their own errors."""
LONGEST_NAME = 255  # longest file name of common file systems, bytes


@contextlib.contextmanager
def draft_of(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path next to ``path``, which is renamed to ``path`` if the block ends without an error.

    Readers see the earlier file or the complete new one, also if several processes write it. The temporary name keeps
    the suffix of ``path``, by which libraries choose a format. ``durable`` waits until the disk holds the content, so
    that a crash of the machine leaves no empty file.
    """
    draft = path.with_name(f".{os.getpid()}-{secrets.token_hex(4)}{DRAFT}{path.name}")
    try:
        yield draft
        if durable:
            flush_to_disk(draft)
        os.replace(draft, path)
        if durable:
            flush_to_disk(path.parent)
    finally:
        draft.unlink(missing_ok=True)


def write_file(path: Path, content: str | bytes, *, durable: bool = False) -> Path:
    """Write ``content`` (text as UTF-8) to ``path`` atomically, and return ``path``. See `draft_of`."""
    with draft_of(path, durable=durable) as draft:
        draft.write_bytes(content.encode() if isinstance(content, str) else content)
    return path


def remove_drafts(folder: Path) -> None:
    """Remove the temporary files of killed processes from a folder to which no other process writes."""
    for draft in folder.glob(f".*-*{DRAFT}*"):
        draft.unlink(missing_ok=True)


def refuse_links(*folders: Path) -> None:
    """Raise `MemobenchError` if a folder is a link: writing or removing files there would change other results."""
    for folder in folders:
        if folder.is_symlink():
            raise MemobenchError(f"{folder} is a link to {os.readlink(folder)}, expected a folder; remove the link")


def file_name(text: object, what: str) -> str:
    """Return a name read from data after checking that it names a file in one folder.

    ``what`` is its role in the error, such as ``the task's name in demo.hdf5``.
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
            f"{what} is {str(text)[:80]!r}, which names no file; expected letters, digits, spaces and _-,.+ only"
        )
    return text


def files_below(folder: Path, *endings: str) -> list[Path]:
    """Return the sorted files below a folder whose names end in one of ``endings``, in any letter case; none: all.

    Links to folders are followed. A pipe, a device, a broken link and an unreadable folder raise `MemobenchError`.
    """

    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            raise MemobenchError(
                f"{error.filename} cannot be read ({error.strerror}); change its permissions"
            ) from None

    files: list[Path] = []
    seen: set[tuple[int, int]] = set()
    for directory, folders, names in os.walk(folder, onerror=refuse, followlinks=True):
        status = os.stat(directory)
        if (status.st_dev, status.st_ino) in seen:  # links in a circle
            folders.clear()
            continue
        seen.add((status.st_dev, status.st_ino))
        folders.sort()
        files += [Path(directory, name) for name in names if not endings or name.lower().endswith(endings)]
    for path in files:
        check_regular(path)
    return sorted(files)


def existing_spelling(path: Path) -> Path:
    """Return the path of a file, whose name may have other letter case on the disk."""
    names = os.listdir(path.parent) if not path.exists() and path.parent.is_dir() else []
    return path.with_name(next((name for name in sorted(names) if name.lower() == path.name.lower()), path.name))


def check_regular(path: Path) -> None:
    """Raise `MemobenchError` if a path exists, but is a pipe, a device or a broken link."""
    if os.path.lexists(path) and not path.is_file() and not path.is_dir():
        raise MemobenchError(f"{path} is a pipe, a device or a broken link, expected a file; remove it")


def cache_base() -> Path:
    """Return the folder in which this package and its libraries (numba, torch, Hugging Face) keep caches."""
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def cache_folder() -> Path:
    """Return the folder of this package's caches."""
    return cache_base() / "lerobot_memobench"


def choose_caches() -> None:
    """Set variables of the environment for a user without a name or a writable home, as in many containers.

    Call it before numba, torch or Hugging Face is imported.
    """
    if sys.platform == "win32":
        return
    try:
        getpass.getuser()
    except (KeyError, OSError):  # torch names a folder by the user
        os.environ["USER"] = f"user-{os.getuid()}"
    base = cache_base()
    while not os.path.exists(base) and base != base.parent:
        base = base.parent
    if not (base.is_absolute() and os.path.isdir(base) and os.access(base, os.W_OK | os.X_OK)):
        with contextlib.suppress(OSError):
            folder = private_folder(tempfile.gettempdir()) / "cache"
            os.environ["XDG_CACHE_HOME"] = str(folder)
            os.environ.setdefault("MPLCONFIGDIR", str(folder / "matplotlib"))
            if os.path.expanduser("~") == "~":
                os.environ["HOME"] = str(folder.parent)


def private_folder(shared: str) -> Path:
    """Make and return this user's own folder in one that all users share, such as ``/tmp``; raise `OSError`."""
    folder = Path(shared) / f"memobench-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    status = folder.lstat()
    # Caches hold code, so the folder must not be another user's.
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid() or status.st_mode & 0o022:
        raise PermissionError(errno.EPERM, "others may write to this folder", str(folder))
    return folder


def file_hash(path: Path) -> str:
    """Return the sha256 (hex) of a file; computed again if the file changes."""
    status = os.stat(path)  # a changed file has another size, time or inode
    return _hash_of(str(path), status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


@functools.lru_cache(maxsize=4096)
def _hash_of(path: str, *version: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def disk_refusal(error: BaseException) -> str | None:
    """Return the system's message if an error is caused by the disk, else None."""
    for current in chain(error):
        number = getattr(current, "errno", None)
        if number in (*FULL, *CLOSED):
            return os.strerror(number)
        match = _IN_WORDS.search(str(current))
        if match and not isinstance(current, MemobenchError):
            return match[0]
    return None


@contextlib.contextmanager
def explaining_disk_errors(out: Path, kept: str = "") -> Iterator[None]:
    """Turn a disk error in writing below the folder ``out`` into a `MemobenchError`.

    ``kept`` ends the message: finished work, and how to continue.
    """
    try:
        yield
    except MemobenchError:
        raise
    except Exception as error:  # OSError, or an error of a library in C
        refusal, end = disk_refusal(error), kept and f"; {kept}"
        filename = getattr(error, "filename", None)
        if refusal is None:
            raise
        if filename is not None:
            path, folder = Path(os.fsdecode(filename)).absolute(), out.absolute()
            if not (path.is_relative_to(folder) or folder.is_relative_to(path)):  # a file that is read
                raise
        try:  # an error of `print` leaves text in the stream
            for stream in filter(None, (sys.stdout, sys.stderr)):
                stream.flush()
        except (OSError, ValueError):  # ValueError: it is closed
            raise MemobenchError(
                f"the output of this command cannot be written ({refusal}): send it elsewhere{end}"
            ) from error
        raise MemobenchError(
            f"{out} cannot be written ({refusal}; {in_words(free_bytes(out))} are free there): make room, or name "
            f"another folder{end}"
        ) from error


def free_bytes(folder: Path) -> int:
    """Return the free bytes of the disk of a folder, which need not exist."""
    folder = folder.absolute()
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


def flush_to_disk(*paths: Path) -> None:
    """Wait until the disk holds files, or the entries of folders."""
    if sys.platform == "win32":
        return  # it cannot open folders, or flush files that are open for reading
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
