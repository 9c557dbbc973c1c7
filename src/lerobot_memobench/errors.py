"""The one error that users see, what led to an error, and the help a message gives."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable, Iterator, Sequence


class MemobenchError(ValueError):
    """Bad input, told in one sentence: what was given, what was expected, what to do.

    The command line prints the message without a traceback and exits with status 2.
    """


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and the errors that led to it, outermost first."""
    seen: set[int] = set()  # an error may be its own cause's cause
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        yield current
        current = current.__cause__ or (None if current.__suppress_context__ else current.__context__)


def unsupported_system() -> str:
    """Return one sentence where nothing can be simulated, "" elsewhere."""
    if sys.platform not in ("win32", "cygwin"):
        return ""
    return "Windows locks no folders, which every run does: use WSL2; docs/start/install.md lists what works without"


def check_choice(name: str, value: object, known: Sequence[str]) -> None:
    """Refuse a setting whose value is none of the known ones.

    Args:
        name: of the setting, as it was given.

    Raises:
        MemobenchError: what it is, and the nearest known values.
    """
    if value not in known:
        raise MemobenchError(f"{name} is {value!r}; {nearest(str(value), known)}")


def nearest(given: str, known: Iterable[str], count: int = 3) -> str:
    """Return a hint that names the known words nearest to ``given``, or all of them when few."""
    words = sorted(known)
    if not words:
        return "there is none"
    close = difflib.get_close_matches(given, words, n=count, cutoff=0.4)
    if close:
        return "did you mean " + " or ".join(repr(word) for word in close) + "?"
    if len(words) <= 12:
        return "known are " + ", ".join(repr(word) for word in words)
    return f"none of the {len(words)} known ones is near"
