"""Read files from strangers: JSON of an expected schema, bounded in size.

The schema is a type: a pydantic model, a `TypedDict`, or a list of them. Values are not converted: "5" is no number,
and true is not 1. Unknown keys are allowed, because later versions may add some. pydantic is imported when the first
file is read, because the import takes as long as a short command.
"""

from __future__ import annotations

import codecs
import contextlib
import gzip
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge, Le, MaxLen, MinLen

from lerobot_memobench.errors import MemobenchError, cut, in_words, short
from lerobot_memobench.io import files_below

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails

LARGEST = 2**53  # larger integers are not all representable as a double, so browsers and arrays may change them

Whole = Annotated[int, Ge(-LARGEST), Le(LARGEST)]
Count = Annotated[int, Ge(0), Le(LARGEST)]
Name = Annotated[str, MinLen(1), MaxLen(255)]
Number = Annotated[float, Ge(-LARGEST), Le(LARGEST)]


LONGEST_REASON = 200  # length of quoted messages of libraries, characters

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
    "extra_forbidden": "no such field",
}
"""pydantic's name of an error -> expected value."""


class Malformed(MemobenchError):
    """Content that does not match a schema; the message is the reason without the file."""


PACKED = ".gz"  # suffix of a file compressed by `gzip`
POINTER, LARGEST_POINTER = b"version https://git-lfs.github.com/spec/v1", 1024
"""First line of a Git LFS pointer, and its largest size, bytes."""
LARGEST_UNPACKED = 256 << 20  # largest unpacked size of a compressed file, bytes: about a hundred thousand episodes


def is_there(path: Path) -> bool:
    """Return whether a file exists, or the same file compressed by ``gzip``."""
    return path.is_file() or packed(path).is_file()


def packed(path: Path) -> Path:
    """Return the path of a file compressed by ``gzip``."""
    return path.with_name(path.name + PACKED)


def check_fetched(path: Path) -> None:
    """Raise `MemobenchError` for a Git LFS pointer, which a clone without git-lfs has, or for a folder with one."""
    for file in files_below(path) if path.is_dir() else [path]:
        if not file.is_file() or file.stat().st_size > LARGEST_POINTER:
            continue
        with file.open("rb") as content:
            if content.read(len(POINTER)) == POINTER:
                raise MemobenchError(
                    f"{file} is a Git LFS pointer without its content; run `git lfs pull` in its repository"
                )


def file_bytes(path: Path) -> bytes:
    """Return the content of a file, or of the same file compressed by ``gzip`` if only that exists.

    A missing, damaged or too large file raises `OSError`, a Git LFS pointer `MemobenchError`.
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

    ``nan`` allows NaN and Infinity, as in logs of a diverged training. A missing file raises `FileNotFoundError`,
    other content than the schema's a `MemobenchError` with the place and the ``advice``.
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
    """Return the value of a JSON text; raise `Malformed`, also for NaN (unless ``nan``) and for invalid UTF-8."""
    from pydantic_core import from_json

    data = content.encode(errors="replace") if isinstance(content, str) else content
    try:
        return from_json(data.removeprefix(codecs.BOM_UTF8), allow_inf_nan=nan)
    except ValueError as error:
        raise Malformed(f"it is not JSON ({error})") from None


def checked(value: Any, schema: Any) -> Any:
    """Return a value that matches ``schema``: an instance if the schema is a pydantic model, else the value itself.

    `Malformed` names the first place that differs, its value and the expected one.
    """
    from pydantic import BaseModel, ValidationError

    try:
        validated = _adapter(schema).validate_python(value, strict=True)
    except ValidationError as error:
        raise Malformed(first_fault(error.errors(include_url=False), value)) from None
    return validated if isinstance(validated, BaseModel) else value


@contextlib.contextmanager
def refusing(as_error: Callable[[str], MemobenchError], of: Path | None = None) -> Iterator[None]:
    """Turn every error of a block that reads possibly damaged files into a `MemobenchError`.

    LeRobot, pyarrow, PyAV, h5py and NumPy raise errors of many types for damaged files. The block must not write,
    because an error in writing, such as a full disk, is not caused by the file.

    ``as_error`` adds file and fix to a library's message in one line. If ``of``, the file or folder that is read, is a
    Git LFS pointer, the message names that instead.
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
    """Return a message for the first error; errors of one place are alternatives of a union."""
    first, *rest = [(*_place(error["loc"], value), error) for error in errors]
    place, faulty, error = first
    if error["type"] == "missing":
        missing = dict.fromkeys(
            str(e["loc"][-1]) for p, _, e in (first, *rest) if e["type"] == "missing" and p == place
        )
        return f"found no {', '.join(missing)}" + (f" in {place}" if place else "")
    start = f"found {f'{place} = ' if place else ''}{short(faulty)}"
    if error["type"] in ("value_error", "assertion_error"):  # an error of a validator
        return f"{start}: {error['ctx']['error']}"
    alternatives = dict.fromkeys(_expected(e) for p, _, e in (first, *rest) if p == place)
    return f"{start}, expected {' or '.join(alternatives)}"


def _expected(error: ErrorDetails) -> str:
    if (known := EXPECTED.get(error["type"])) is not None:
        return known.format(**error.get("ctx", {}))
    return error["msg"].removeprefix("Input should be ").lower()


def _place(location: Iterable[int | str], value: Any) -> tuple[str, Any]:
    # A location may include names of union members, which are no parts of the value.
    text = ""
    for part in location:
        if isinstance(value, Mapping) and part in value:
            text, value = f"{text}.{part}" if text else str(part), value[part]
        elif isinstance(value, list) and isinstance(part, int):
            text, value = f"{text}[{part}]", value[part]
        else:
            break
    return cut(text), value
