"""Define, build, check, traverse and format formulas of goals and checkpoints: trees of operators over atoms.

The published tasks use four operators; the strict suite adds five. The simulator evaluates atoms. `tasks.progress`
implements operators and latches (``wasopen``, ``wasturnedon``) over time, see ``docs/benchmark/formulas.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest, short

#: Predicate (lower case) -> (spelling in BDDL, number of arguments).
PREDICATES: dict[str, tuple[str, int]] = {
    "in": ("In", 2),
    "on": ("On", 2),
    "open": ("Open", 1),
    "close": ("Close", 1),
    "turnon": ("TurnOn", 1),
    "turnoff": ("TurnOff", 1),
    "wasopen": ("WasOpen", 1),
    "wasturnedon": ("WasTurnedOn", 1),
    "handhome": ("HandHome", 0),
    "asbegun": ("AsBegun", 0),
    "ajar": ("Ajar", 1),
    "inplace": ("InPlace", 1),
    "lifted": ("Lifted", 1),
}

#: Latched predicate -> the simulator predicate that sets it.
LATCHES: dict[str, str] = {"wasopen": "open", "wasturnedon": "turnon"}

#: Predicates that compare the present with the start of the execution; invalid in ``:init``.
SINCE_START = frozenset({"handhome", "asbegun", "ajar", "inplace", "lifted"})

MAX_NUMBER = 100_000  # largest number in a formula: more steps than any episode has

MAX_DEPTH = 40  # maximum nesting depth; bounds recursion on malformed files


@dataclass(frozen=True)
class Atom:
    """A predicate (lower case, a key of ``PREDICATES``) applied to entity names."""

    predicate: str
    args: tuple[str, ...]

    def __str__(self) -> str:
        return format_formula(self)


@dataclass(frozen=True)
class _OverOne:
    child: Formula


@dataclass(frozen=True)
class _OverSeveral:
    children: tuple[Formula, ...]


@dataclass(frozen=True)
class Counted:
    """An operator with a number."""

    number: int
    child: Formula


class And(_OverSeveral):
    """True when all children are true; every child is evaluated at every step."""


class Or(_OverSeveral):
    """True when any child is true; every child is evaluated at every step."""


class Not(_OverOne):
    """True when the child is not."""


class Then(_OverSeveral):
    """True from the step in which the last child is done, in order, onwards; see ``Evaluator``."""


class Never(_OverOne):
    """True until the child is true in any step, then permanently false."""


class Hold(Counted):
    """True when the child has been true in each of the last ``number`` steps, the present one included."""


class Exactly(Counted):
    """True while the child has had exactly ``number`` rising edges (the first step counts as one)."""


class When(_OverSeveral):
    """Latch the value of the second child in the first step in which the first child is true; false before."""


class Round(_OverSeveral):
    """True in the step in which the last child comes true after the earlier ones, in order; then restart."""


Formula = Atom | And | Or | Not | Then | Never | Hold | Exactly | When | Round

_OPERATORS = (And, Or, Not, Then, Never, Hold, Exactly, When, Round)
#: Word (lower case) -> operator; its class's name is the spelling in BDDL.
OPERATORS: dict[str, type[Formula]] = {operator.__name__.lower(): operator for operator in _OPERATORS}


# --- walking ---


def children(formula: Formula) -> tuple[Formula, ...]:
    """Return the direct children of ``formula``; an atom has none."""
    if isinstance(formula, Atom):
        return ()
    return formula.children if isinstance(formula, _OverSeveral) else (formula.child,)


def walk(formula: Formula) -> Iterator[Formula]:
    """Yield ``formula`` and its descendants, parents first, from left to right."""
    yield formula
    for child in children(formula):
        yield from walk(child)


def atoms(formula: Formula) -> Iterator[Atom]:
    """Yield the atoms of ``formula`` from left to right, including repetitions."""
    return (part for part in walk(formula) if isinstance(part, Atom))


def rename(formula: Formula, names: Mapping[str, str]) -> Formula:
    """Return ``formula`` with entity names replaced, all at once (so ``{"a": "b", "b": "a"}`` swaps)."""
    if isinstance(formula, Atom):
        return Atom(formula.predicate, tuple(names.get(arg, arg) for arg in formula.args))
    if isinstance(formula, _OverSeveral):
        return replace(formula, children=tuple(rename(child, names) for child in formula.children))
    return replace(formula, child=rename(formula.child, names))


# --- writing ---


def to_lists(formula: Formula) -> list[Any]:
    """Return ``formula`` as nested lists of lower-case words: the inverse of ``parse_formula``."""
    if isinstance(formula, Atom):
        return [formula.predicate, *formula.args]
    head = [type(formula).__name__.lower(), *([formula.number] if isinstance(formula, Counted) else [])]
    return [*head, *(to_lists(child) for child in children(formula))]


def format_formula(formula: Formula) -> str:
    """Return ``formula`` in BDDL on one line, e.g. ``(And (On a b) (Not (Open c)))``."""
    if isinstance(formula, Atom):
        return f"({' '.join((PREDICATES[formula.predicate][0], *formula.args))})"
    number = [str(formula.number)] if isinstance(formula, Counted) else []
    return f"({' '.join([type(formula).__name__, *number, *map(format_formula, children(formula))])})"


# --- building: every error message names the place ---

#: Operators with a fixed number of children; the others take one or more.
_PARTS: dict[type[Formula], int] = {Not: 1, Never: 1, Hold: 1, Exactly: 1, When: 2}
_WORDS = {1: "exactly one", 2: "exactly two"}


def make_atom(predicate: str, args: Sequence[str], where: str) -> Atom:
    """Return a checked atom; ``where`` (file and line) is the prefix of error messages."""
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


def make_operator(operator: type[Formula], parts: Sequence[Formula], where: str, number: Any = None) -> Formula:
    """Return a checked operator; `Hold` and `Exactly` need a number from 1."""
    name = operator.__name__
    if issubclass(operator, Counted):
        expected = f"expected a whole number from 1 to {MAX_NUMBER}"
        if number is None:
            raise MemobenchError(f"{where}: found {name} without a number, {expected} before a formula")
        if not isinstance(number, int) or isinstance(number, bool) or not 1 <= number <= MAX_NUMBER:
            raise MemobenchError(f"{where}: found {number!r} after {name}, {expected}")
    if not parts:
        raise MemobenchError(f"{where}: found {name} without a formula, expected at least one")
    if len(parts) != _PARTS.get(operator, len(parts)):
        raise MemobenchError(f"{where}: found {name} over {len(parts)} formulas, expected {_WORDS[_PARTS[operator]]}")
    make: Callable[..., Formula] = operator
    if issubclass(operator, Counted):
        return make(number, parts[0])
    return make(parts[0] if _PARTS.get(operator) == 1 else tuple(parts))


# --- reading JSON formulas of metadata files: nested lists, objects, or both ---

_KEYS = ", ".join(map(repr, OPERATORS))


def parse_formula(value: Any, where: str = "formula", depth: int = 0) -> Formula:
    """Parse a formula from nested lists or JSON objects.

    ``["And", ["On", "a", "b"]]`` and ``{"and": [["on", "a", "b"]]}`` are equal. Words are case-insensitive, both forms
    may be mixed, and an operator may hold a bare atom instead of a list. A number precedes the formula:
    ``["exactly", 2, ["open", "a"]]``, ``{"exactly": [2, ["open", "a"]]}``.

    Raises:
        MemobenchError: ``value`` is not a formula; the message begins with ``where``.
    """
    if depth > MAX_DEPTH:
        raise MemobenchError(f"{where}: found a formula nested deeper than {MAX_DEPTH} levels, expected a flatter one")
    if isinstance(value, Mapping):
        head, items = _from_object(value, where)
    elif isinstance(value, (list, tuple)) and value and isinstance(value[0], str):
        head, items = value[0], value[1:]
    else:
        raise MemobenchError(f"{where}: found {short(value)}, expected a formula such as ['on', 'a', 'b']")
    if (operator := OPERATORS.get(head.lower())) is not None:
        numbered = issubclass(operator, Counted) and items and not isinstance(items[0], (list, tuple, Mapping))
        number, parts = (items[0], items[1:]) if numbered else (None, items)
        return make_operator(operator, [parse_formula(item, where, depth + 1) for item in parts], where, number)
    for item in items:
        if not isinstance(item, str) or not item:
            raise MemobenchError(f"{where}: found {short(item)} as an argument of {head!r}, expected an entity name")
    return make_atom(head, items, where)


def _from_object(value: Mapping[Any, Any], where: str) -> tuple[str, Sequence[Any]]:
    if len(value) != 1:
        raise MemobenchError(f"{where}: found an object with {len(value)} keys, expected one of {_KEYS}")
    ((head, rest),) = value.items()
    if not isinstance(head, str) or head.lower() not in OPERATORS:
        raise MemobenchError(f"{where}: found the key {head!r}, expected one of {_KEYS}")
    # {"not": ["on", "a", "b"]} and {"not": {"and": ...}} hold one formula, not a list of them.
    bare = isinstance(rest, Mapping) or (isinstance(rest, (list, tuple)) and rest and isinstance(rest[0], str))
    items = [rest] if bare else rest
    if not isinstance(items, (list, tuple)):
        raise MemobenchError(f"{where}: found {short(rest)} under {head!r}, expected a list of formulas")
    return head, items
