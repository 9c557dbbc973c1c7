"""Read the HDF5 files of a zip archive one at a time: 340 GiB need not be unpacked to be read."""

from __future__ import annotations

import shutil
import stat
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

from lerobot_memobench.datasets.hdf5.reading import SUFFIXES, Problem, Unusable, first_line
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched, draft_of, file_name, in_words

MOST_FILES = 10_000
"""Files of an archive; the published one has 30."""
LARGEST_RATIO = 1100
"""Bytes that a packed byte can become: deflate makes up to 1,032 of one."""
NOT_OF_ANYBODY = "__MACOSX"
"""Folder that macOS adds to what it packs."""
COPIED = 2**22
"""Bytes that are unpacked at a time."""


@dataclass(frozen=True)
class Member:
    """An HDF5 file of an archive: its name with its folders, its size unpacked, its checksum, where it is."""

    name: str
    size: int
    checksum: int
    info: zipfile.ZipInfo


class Archive:
    """A zip archive of HDF5 files.

    Attributes:
        path: of the archive.
        members: the files that may be read, sorted by name.
        problems: the files that are refused, and why.

    Raises:
        MemobenchError: it is no zip archive, is not there as a whole, or has no HDF5 file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        check_fetched(path)
        try:
            with zipfile.ZipFile(path) as file:
                infos = file.infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError) as error:
            raise MemobenchError(
                f"{path} is no zip archive, or was not downloaded to its end ({first_line(error)}); download it again"
            ) from None
        wanted = [info for info in infos if _is_hdf5(info.filename) and not info.filename.startswith(NOT_OF_ANYBODY)]
        if not 0 < len(wanted) <= MOST_FILES:
            raise MemobenchError(
                f"found {len(wanted):,} HDF5 files ({', '.join(SUFFIXES)}) in {path}, expected 1 to {MOST_FILES:,}"
            )
        self.members: list[Member] = []
        self.problems: list[Problem] = []
        taken: set[str] = set()
        for info in sorted(wanted, key=lambda info: info.filename):
            try:
                self.members.append(_checked(info, taken))
            except MemobenchError as error:
                self.problems.append(Problem(_printable(info.filename), "", str(error)))

    @property
    def size(self) -> int:
        """Bytes of all members, unpacked."""
        return sum(member.size for member in self.members)

    def extract(self, member: Member, folder: Path) -> Path:
        """Write a member to its name below ``folder``, whole or not at all, and return its path.

        Raises:
            Unusable: its bytes are not those that were packed.
        """
        path = folder / member.name
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with draft_of(path) as draft:
                with zipfile.ZipFile(self.path) as file, file.open(member.info) as packed, draft.open("wb") as unpacked:
                    shutil.copyfileobj(packed, unpacked, COPIED)
                if draft.stat().st_size != member.size:
                    raise Unusable(f"it is {in_words(draft.stat().st_size)} long, not {in_words(member.size)}")
        except MemobenchError:
            raise
        except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, ValueError) as error:
            raise Unusable(f"it cannot be unpacked ({first_line(error)}); download the archive again") from None
        return path


def is_archive(path: Path) -> bool:
    """Whether a path is a zip archive by its name."""
    return path.is_file() and path.suffix.lower() == ".zip"


def _is_hdf5(name: str) -> bool:
    return Path(name).suffix in SUFFIXES


def _printable(name: str) -> str:
    return "".join(letter if letter.isprintable() else "?" for letter in name)[:200]


def _checked(info: zipfile.ZipInfo, taken: set[str]) -> Member:
    """Return a member that may be read; its name is then ``taken``.

    Raises:
        MemobenchError: its name leads elsewhere or is there already, it is no plain file, or its size cannot be true.
    """
    parts = [file_name(part, "a part of its name") for part in info.filename.split("/")]
    name = "/".join(parts)
    if name.casefold() in taken:
        raise Unusable("the archive has two files of this name")
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        raise Unusable("it is a link, or something else that is no file")
    if info.flag_bits & 1:
        raise Unusable("it is encrypted; unpack it with its password and name the folder")
    if info.file_size > LARGEST_RATIO * max(info.compress_size, 1):
        raise Unusable(
            f"it claims to become {in_words(info.file_size)} of {in_words(info.compress_size)}, more than is possible"
        )
    taken.add(name.casefold())
    return Member(name, info.file_size, info.CRC, info)
