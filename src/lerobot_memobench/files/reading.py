"""How is a file with JSON in it read, so that whatever it holds ends in a value of the expected shape or in a sentence?

What a file may hold is a type: a `TypedDict`, a list of them. It is held against what was read without turning one
type into another: "5" is no number, true is no 1. Keys that a type does not name are let pass, since a later version
may write more. pydantic is imported when the first file is read, which costs as much as the rest of a short command.
"""

from __future__ import annotations

import codecs
import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge, Le, MaxLen, MinLen

from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from pydantic import TypeAdapter
    from pydantic_core import ErrorDetails

LARGEST = 2**53
"""Beyond it not every integer is a double, so neither a browser nor an array of numbers would hold it."""

Whole = Annotated[int, Ge(-LARGEST), Le(LARGEST)]
Count = Annotated[int, Ge(0), Le(LARGEST)]
Name = Annotated[str, MinLen(1), MaxLen(255)]
Number = Annotated[float, Ge(-LARGEST), Le(LARGEST)]

LONGEST = 80
"""Characters of what was found that a message repeats."""

LONGEST_REASON = 200
"""Characters of what a library says that a message repeats."""

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
    """What was read is not of the expected shape; the message is the reason alone."""


def read_json(path: Path, schema: Any, advice: str, *, nan: bool = False) -> Any:
    """Return what a JSON file of ours holds.

    Args:
        schema: the type that it must have. advice: ends the sentence: what to do.
        nan: whether NaN and Infinity are numbers, as of a training that diverged.

    Raises:
        FileNotFoundError: there is none, which is the caller's to judge.
        MemobenchError: it cannot be read or is not of the schema, named with the place in it.
    """
    try:
        return checked(parsed(path.read_bytes(), nan=nan), schema)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise MemobenchError(f"{path} cannot be read ({error.strerror or error}); {advice}") from None
    except Malformed as error:
        raise MemobenchError(f"{path}: {error}; {advice}") from None


def parsed(content: bytes | str, *, nan: bool = False) -> Any:
    """Return the value that JSON text says; NaN (unless ``nan``), lone surrogates and bad UTF-8 are no JSON.

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
    """Return ``value`` itself, if it is of the type ``schema``.

    Raises:
        Malformed: with the first place that is not: what was found there, and what was expected.
    """
    from pydantic import ValidationError

    try:
        _adapter(schema).validate_python(value, strict=True)
    except ValidationError as error:
        raise Malformed(first_fault(error.errors(include_url=False), value)) from None
    return value


@contextlib.contextmanager
def refusing(told: Callable[[str], MemobenchError]) -> Iterator[None]:
    """Let nothing but a `MemobenchError` out of a block that does nothing but read what may be damaged.

    LeRobot, pyarrow, PyAV, h5py and NumPy answer damaged files with errors of every type. To be kept around reading
    alone: an error in writing, such as a full disk, is not the file's.

    Args:
        told: makes the error, from what was raised in at most a line. The file and what to do stand beside that: of
            what a library says only the first characters are left.
    """
    try:
        yield
    except MemobenchError:
        raise
    except Exception as error:
        raise told(f"{type(error).__name__}: {cut(' '.join(str(error).split()), LONGEST_REASON)}") from error


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
    told = f"found {f'{place} = ' if place else ''}{short(found)}"
    if error["type"] in ("value_error", "assertion_error"):  # a check of ours, in its own words
        return f"{told}: {error['ctx']['error']}"
    alternatives = dict.fromkeys(_expected(e) for p, _, e in (first, *others) if p == place)
    return f"{told}, expected {' or '.join(alternatives)}"


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
    """Return what was found, as far as a sentence can hold it."""
    return cut(repr(value))


def cut(text: str, longest: int = LONGEST) -> str:
    """Return a text, as far as a sentence can hold it."""
    return text if len(text) <= longest else text[: longest - 1] + "…"


def count_of(number: int, word: str) -> str:
    """Return a number of things in words, such as ``1 task`` or ``1,500 rollouts``."""
    return f"{number:,} {word}" + ("" if number == 1 else "s")
