"""Make atoms and operators from their words, checked; every complaint says where."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.formula import (
    MAX_NUMBER,
    OPERATORS,
    PREDICATES,
    Atom,
    Exactly,
    Formula,
    Hold,
    Never,
    Not,
    When,
    takes_number,
)

#: Operators over a fixed number of formulas; the others take one or more.
_PARTS: dict[type[Formula], int] = {Not: 1, Never: 1, Hold: 1, Exactly: 1, When: 2}
_WORDS = {1: "exactly one", 2: "exactly two"}


def make_atom(predicate: str, args: Sequence[str], where: str = "formula") -> Atom:
    """Return a checked atom; ``where`` (file and line) opens the message of a ``MemobenchError``."""
    key = predicate.lower()
    if key not in PREDICATES:
        hint = nearest(key, [*PREDICATES, *OPERATORS])
        raise MemobenchError(f"{where}: found the unknown predicate or operator {predicate!r}, {hint}")
    spelling, arity = PREDICATES[key]
    if len(args) != arity:
        raise MemobenchError(
            f"{where}: found {len(args)} argument(s) after {spelling}, expected {arity} entity name(s)"
        )
    if len(set(args)) != len(args):
        raise MemobenchError(f"{where}: found {spelling} with {args[0]!r} twice, expected two different entities")
    return Atom(key, tuple(args))


def make_operator(
    operator: str, parts: Sequence[Formula], where: str = "formula", number: int | str | None = None
) -> Formula:
    """Return ``operator`` (any case) over its parts; `Hold` and `Exactly` need a ``number`` from 1 on."""
    key = operator.lower()
    if key not in OPERATORS:
        raise MemobenchError(f"{where}: found the operator {operator!r}, {nearest(key, OPERATORS)}")
    made = OPERATORS[key]
    counted = [check_number(number, made.__name__, where)] if takes_number(key) else []
    if not parts:
        raise MemobenchError(f"{where}: found {made.__name__} with nothing in it, expected at least one formula")
    if len(parts) != _PARTS.get(made, len(parts)):
        raise MemobenchError(
            f"{where}: found {made.__name__} over {len(parts)} formulas, expected {_WORDS[_PARTS[made]]}"
        )
    make: Callable[..., Formula] = made
    return make(*counted, tuple(parts) if made not in _PARTS or made is When else parts[0])


def check_number(number: Any, after: str, where: str) -> int:
    """Return the number that stands after an operator's word; raise where it is none from 1 on."""
    if number is None:
        raise MemobenchError(
            f"{where}: found {after} without a number, expected a whole number from 1 to {MAX_NUMBER} before a formula"
        )
    if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= MAX_NUMBER:
        raise MemobenchError(f"{where}: found {number!r} after {after}, expected a whole number from 1 to {MAX_NUMBER}")
    return number
