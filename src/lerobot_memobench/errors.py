"""The error class of this package, chains of errors, and parts of messages."""

from __future__ import annotations

import difflib
import sys
import traceback
from collections.abc import Iterable, Iterator, Sequence
from typing import Any


class MemobenchError(ValueError):
    """Invalid input. The message names the value, the expected one and the fix.

    Commands print the message without a traceback and exit with status 2.
    """


def chain(error: BaseException) -> Iterator[BaseException]:
    """Yield an error and its causes, outermost first."""
    seen: set[int] = set()  # an error may be its own cause's cause
    current: BaseException | None = error
    while current is not None and id(current) not in seen:
        seen.add(id(current))
        yield current
        current = current.__cause__ or (None if current.__suppress_context__ else current.__context__)


def came_through(error: BaseException, package: str) -> bool:
    """Return whether an error passed through a module of a package."""
    frames = (frame for frame, _ in traceback.walk_tb(error.__traceback__))
    return any(str(frame.f_globals.get("__name__")).startswith(package) for frame in frames)


def unsupported_system() -> str:
    """Return a message on systems without support for simulation, "" on others."""
    if sys.platform not in ("win32", "cygwin"):
        return ""
    return "Windows cannot lock folders, as every run does: use WSL2; docs/start/install.md lists supported commands"


def check_choice(name: str, value: object, known: Sequence[str]) -> None:
    """Raise `MemobenchError`, which names the nearest known values, for another ``value`` of the setting ``name``."""
    if value not in known:
        raise MemobenchError(f"{name} is {value!r}; {nearest(str(value), known)}")


HINTS = {"libero_long": "LIBERO-Long is 'libero_10'"}  # word of a paper -> the hint in place of near words


def nearest(unknown: str, known: Iterable[str]) -> str:
    """Return a hint that names the known words nearest to ``unknown``, or all of them if there are few."""
    if unknown.rpartition(".")[2] in HINTS:
        return HINTS[unknown.rpartition(".")[2]]
    words = sorted(known)
    if not words:
        return "there is none"
    likeness = {word: difflib.SequenceMatcher(None, word, unknown).ratio() for word in words}
    least = max(0.4, 3 * max(likeness.values()) - 2)  # a word that is much nearer is the only one
    close = sorted((word for word in words if likeness[word] >= least), key=lambda word: -likeness[word])[:3]
    if close:
        return "did you mean " + " or ".join(repr(word) for word in close) + "?"
    if len(words) <= 12:
        return "known are " + ", ".join(repr(word) for word in words)
    return f"none of the {len(words)} known ones is near"


LONGEST = 80  # length of quoted values in messages, characters


def short(value: Any) -> str:
    """Return the representation of a value, shortened for messages."""
    return cut(repr(value))


def cut(text: str, longest: int = LONGEST) -> str:
    """Return a text, shortened for messages."""
    return text if len(text) <= longest else text[: longest - 1] + "…"


def count_of(number: int, word: str) -> str:
    """Return a number with its noun, such as ``1 task`` or ``1,500 rollouts``."""
    return f"{number:,} {word}" + ("" if number == 1 else "s")


def in_words(size: float) -> str:
    """Return a number of bytes with its unit, such as ``45.8 GiB``."""
    number, units = float(size), ["B", "KiB", "MiB", "GiB", "TiB"]
    while number >= 1024 and len(units) > 1:
        number /= 1024
        del units[0]
    return f"{number:.1f} {units[0]}" if units[0] != "B" else f"{number:.0f} B"
