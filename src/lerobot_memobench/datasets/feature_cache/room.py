"""Is there room for a cache on the disk, and what is told when there is none?"""

from __future__ import annotations

import contextlib
import errno
import os
from collections.abc import Iterator, Mapping
from pathlib import Path

from lerobot_memobench.datasets.feature_cache.layout import TOKENS_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import FULL, free_bytes, in_words

_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)
_ELSEWHERE = "put it elsewhere (`memobench cache --out`, --policy.memory_cache_dir)"


def reserve(path: Path, size: int) -> None:
    """Make ``path`` a file of ``size`` bytes that the disk has room for; what it holds already stays.

    A file with holes would take no room until it is written to, and a full disk would end the build hours later.

    Raises:
        MemobenchError: the disk has no room. Nothing is changed then.
    """
    path.touch()
    missing = size - path.stat().st_blocks * 512
    if missing <= 0:
        return
    free = free_bytes(path.parent)
    if free < missing:
        raise no_room(path.parent, f"{in_words(missing)} are needed there and {in_words(free)} are free")
    with path.open("r+b") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:  # macOS
            file.truncate(size)


def require_room(place: Path, folders: Mapping[Path, int]) -> None:
    """Refuse caches in ``place``, folder -> bytes of its tokens, if the disk lacks room for all that are not begun.

    Raises:
        MemobenchError: it does. Nothing is changed then.
    """
    missing = sum(size for folder, size in folders.items() if not (folder / TOKENS_FILE).is_file())
    free = free_bytes(place)
    if free < missing:
        raise no_room(place, f"{in_words(missing)} are needed there and {in_words(free)} are free")


def no_room(folder: Path, found: str) -> MemobenchError:
    """Return the error of a disk that is full; ``found`` says how one knows."""
    return MemobenchError(
        f"The memory cache {folder} does not fit on its disk: {found}; make room, store fewer frames "
        f"(--policy.memory_stride, `memobench cache --stride`), or {_ELSEWHERE}."
    )


@contextlib.contextmanager
def telling_of_the_disk(folder: Path) -> Iterator[None]:
    """Turn what the disk answers to writing a cache into one sentence.

    Raises:
        MemobenchError: the disk is full, or nothing may be written there.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise no_room(folder, f"it is full ({error.strerror})") from error
        if error.errno in _CLOSED and error.filename is not None and _is_of(Path(error.filename), folder):
            raise MemobenchError(
                f"The memory cache {folder} cannot be written ({error.strerror}); {_ELSEWHERE}."
            ) from error
        raise


def _is_of(path: Path, folder: Path) -> bool:
    """Whether a path is where a cache lies, or on the way to it; not a dataset's video."""
    return path.is_relative_to(folder.parent) or folder.is_relative_to(path)
