"""Write files whole, keep names out of data inside their folder, read JSON into an expected shape.

No file is ever half written. An error of the disk, full or read-only, becomes one sentence.
"""

from __future__ import annotations

import codecs
import contextlib
import errno
import functools
import gzip
import hashlib
import os
import re
import secrets
import shutil
import sys
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge, Le, MaxLen, MinLen

from lerobot_memobench.errors import MemobenchError, chain

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails


DRAFT = ".part."
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.EIO)
_IN_WORDS = re.compile(
    "|".join(os.strerror(number) for number in (*FULL, errno.EACCES, errno.EROFS, errno.EIO)), re.IGNORECASE
)
"""Libraries in C put the system's message into errors of their own."""
LONGEST_NAME = 255
"""Bytes of a file's name that common file systems take."""


@contextlib.contextmanager
def draft_of(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``; it takes that name once the block has ended without an error.

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
    """Remove the drafts of killed processes from a folder to which no other process writes."""
    for draft in folder.glob(f".*-*{DRAFT}*"):
        draft.unlink(missing_ok=True)


def file_name(text: object, what: str) -> str:
    """Return a name that came out of data, if it names a file in a folder and nothing anywhere else.

    Args:
        text: the name as it was read. what: its role, for the message: ``the task's name in demo.hdf5``.

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


def cache_folder() -> Path:
    """Return the folder for files that this package can make again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "lerobot_memobench"


def as_path(word: str) -> str:
    """Return a word of a command line in which every library recognises a path.

    ``~/`` at the beginning is expanded: not every shell does that behind ``key=``, and none in quotes.
    An existing path with a colon becomes absolute: Arrow and FFmpeg read ``run: 2`` as an address.
    """
    key, equals, value = word.partition("=")
    path = value if equals else word
    if path.startswith("~/"):
        path = os.path.expanduser(path)
    elif ":" in path and os.path.exists(path):
        path = os.path.abspath(path)
    return key + equals + path if equals else path


def file_hash(path: Path) -> str:
    """Return the sha256 (hex) of a file; one that has not changed is read once per process."""
    found = os.stat(path)
    return _hash_of(str(path), found.st_ino, found.st_size, found.st_mtime_ns)


@functools.lru_cache(maxsize=4096)
def _hash_of(path: str, *version: int) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def disk_refusal(error: BaseException) -> str | None:
    """Return the system's message where an error came from writing to a disk, else None."""
    for current in chain(error):
        number = getattr(current, "errno", None)
        if number in (*FULL, *CLOSED):
            return os.strerror(number)
        found = _IN_WORDS.search(str(current))
        if found and not isinstance(current, MemobenchError):
            return found[0]
    return None


@contextlib.contextmanager
def telling_of_the_disk(out: Path, kept: str = "") -> Iterator[None]:
    """Turn an error of the disk in writing below ``out`` into one sentence.

    Args:
        out: the folder that is written. kept: ends the sentence: finished work, and how to go on.

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
    """Return a number of bytes with its unit, such as ``45.8 GiB``."""
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


# -- reading JSON: whatever a file holds ends in a value of the expected shape, or in a sentence -----------------------
#
# The schema of a file is a type: a pydantic model, a `TypedDict`, a list of them. No type is turned into another: "5"
# is no number, true is no 1. Keys that a type does not name pass, since a later version may write more. pydantic is
# imported when the first file is read, which costs as much as the rest of a short command.

LARGEST = 2**53
"""Beyond it not every integer is a double, so neither a browser nor an array of numbers would hold it."""

Whole = Annotated[int, Ge(-LARGEST), Le(LARGEST)]
Count = Annotated[int, Ge(0), Le(LARGEST)]
Name = Annotated[str, MinLen(1), MaxLen(255)]
Number = Annotated[float, Ge(-LARGEST), Le(LARGEST)]

LONGEST = 80
"""Characters of what was found that a message repeats."""

LONGEST_REASON = 200
"""Characters of a library's message that a message of ours repeats."""

EXPECTED = {
    "string_type": "text",
    "int_type": "an integer",
    "float_type": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "list_type": "a list",
    "dict_type": "an object",
    "none_required": "null",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge}",
    "less_than_equal": "at most {le}",
    "too_short": "{min_length} entries at least",
    "too_long": "{max_length} entries at most",
}
"""pydantic's name of an error -> what was expected."""


class Malformed(MemobenchError):
    """Content that is not of the expected shape; the message is the reason alone."""


PACKED = ".gz"
"""What ``gzip`` puts behind the name of a file that it compresses."""
POINTER, LARGEST_POINTER = b"version https://git-lfs.github.com/spec/v1", 1024
"""The first line of a Git LFS pointer, and the bytes that one has at most."""
LARGEST_UNPACKED = 256 << 20
"""Bytes that a compressed file may become: some hundred thousand episodes."""


def is_there(path: Path) -> bool:
    """Return whether there is a file, or the same file compressed by ``gzip``."""
    return path.is_file() or packed(path).is_file()


def packed(path: Path) -> Path:
    """Return where ``gzip`` puts a file."""
    return path.with_name(path.name + PACKED)


def check_fetched(path: Path) -> None:
    """Refuse a file, or a folder with a file, that is a Git LFS pointer: a clone without git-lfs has no more of it.

    Raises:
        MemobenchError: naming the first such file. OSError: it cannot be read.
    """
    for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
        if not file.is_file() or file.stat().st_size > LARGEST_POINTER:
            continue
        with file.open("rb") as content:
            if content.read(len(POINTER)) == POINTER:
                raise MemobenchError(
                    f"{file} is a Git LFS pointer in the place of its content; run `git lfs pull` in its repository"
                )


def file_bytes(path: Path) -> bytes:
    """Return the content of a file, or of the same file compressed by ``gzip`` where only that exists.

    Raises:
        FileNotFoundError: there is neither. OSError: it cannot be read, is damaged, or becomes too large.
        MemobenchError: it is a Git LFS pointer.
    """
    if path.suffix != PACKED and not path.exists() and packed(path).exists():
        path = packed(path)
    check_fetched(path)
    if path.suffix != PACKED:
        return path.read_bytes()
    try:
        with gzip.open(path) as file:
            content = file.read(LARGEST_UNPACKED + 1)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise OSError(f"it is no whole gzip file: {error}") from None
    if len(content) > LARGEST_UNPACKED:
        raise OSError(f"it becomes larger than {in_words(LARGEST_UNPACKED)}")
    return content


def read_json(path: Path, schema: Any, advice: str, *, nan: bool = False) -> Any:
    """Return the content of a JSON file, which may be compressed (`file_bytes`).

    Args:
        schema: the type that it must have. advice: ends the message with the fix.
        nan: whether NaN and Infinity are numbers, as of a training that diverged.

    Raises:
        FileNotFoundError: there is none.
        MemobenchError: it cannot be read or is not of the schema, named with the place in it.
    """
    try:
        return checked(parsed(file_bytes(path), nan=nan), schema)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror or error}); {advice}") from None
    except Malformed as error:
        raise MemobenchError(f"{path}: {error}; {advice}") from None


def parsed(content: bytes | str, *, nan: bool = False) -> Any:
    """Return the value of a JSON text; NaN (unless ``nan``), lone surrogates and bad UTF-8 are no JSON.

    Raises:
        Malformed: it is no JSON, or nested deeper than any file of ours.
    """
    from pydantic_core import from_json

    data = content.encode(errors="replace") if isinstance(content, str) else content
    try:
        return from_json(data.removeprefix(codecs.BOM_UTF8), allow_inf_nan=nan)
    except ValueError as error:
        raise Malformed(f"it is not JSON ({error})") from None


def checked(value: Any, schema: Any) -> Any:
    """Return ``value`` if it is of the type ``schema``: as the model where the schema is one, else itself.

    Raises:
        Malformed: with the first place that is not: its value, and the value that was expected.
    """
    from pydantic import BaseModel, ValidationError

    try:
        found = _adapter(schema).validate_python(value, strict=True)
    except ValidationError as error:
        raise Malformed(first_fault(error.errors(include_url=False), value)) from None
    return found if isinstance(found, BaseModel) else value


@contextlib.contextmanager
def refusing(as_error: Callable[[str], MemobenchError], of: Path | None = None) -> Iterator[None]:
    """Turn every error of a block that reads possibly damaged files into a `MemobenchError`.

    LeRobot, pyarrow, PyAV, h5py and NumPy answer damaged files with errors of every type. To be kept around reading
    alone: an error in writing, such as a full disk, is not the file's.

    Args:
        as_error: makes the error from a library's message, shortened to one line. It adds the file and the fix.
        of: the file or folder that is read; a Git LFS pointer in its place is named before damage is (`check_fetched`).
    """
    try:
        yield
    except MemobenchError:
        raise
    except Exception as error:
        if of is not None:
            with contextlib.suppress(OSError):
                check_fetched(of)
        raise as_error(f"{type(error).__name__}: {cut(' '.join(str(error).split()), LONGEST_REASON)}") from error


@cache
def _adapter(schema: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(schema)


def first_fault(errors: Iterable[ErrorDetails], value: Any) -> str:
    """Return the first error in words; those of one place are the alternatives of a union."""
    first, *others = [(*_place(error["loc"], value), error) for error in errors]
    place, found, error = first
    if error["type"] == "missing":
        missing = dict.fromkeys(
            str(e["loc"][-1]) for p, _, e in (first, *others) if e["type"] == "missing" and p == place
        )
        return f"found no {', '.join(missing)}" + (f" in {place}" if place else "")
    start = f"found {f'{place} = ' if place else ''}{short(found)}"
    if error["type"] in ("value_error", "assertion_error"):  # a check of ours, in its own words
        return f"{start}: {error['ctx']['error']}"
    alternatives = dict.fromkeys(_expected(e) for p, _, e in (first, *others) if p == place)
    return f"{start}, expected {' or '.join(alternatives)}"


def _place(location: Iterable[int | str], value: Any) -> tuple[str, Any]:
    """Return the path to what was found, and that. pydantic also names members of unions, and absent keys."""
    text = ""
    for part in location:
        if isinstance(value, Mapping) and part in value:
            text, value = f"{text}.{part}" if text else str(part), value[part]
        elif isinstance(value, list) and isinstance(part, int):
            text, value = f"{text}[{part}]", value[part]
        else:
            break
    return cut(text), value


def _expected(error: ErrorDetails) -> str:
    known = EXPECTED.get(error["type"])
    if known is None:
        return error["msg"].removeprefix("Input should be ").lower()
    return known.format(**error.get("ctx", {}))


def short(value: Any) -> str:
    """Return the representation of a value, shortened to fit into a sentence."""
    return cut(repr(value))


def cut(text: str, longest: int = LONGEST) -> str:
    """Return a text, shortened to fit into a sentence."""
    return text if len(text) <= longest else text[: longest - 1] + "…"


def count_of(number: int, word: str) -> str:
    """Return a number of things in words, such as ``1 task`` or ``1,500 rollouts``."""
    return f"{number:,} {word}" + ("" if number == 1 else "s")
