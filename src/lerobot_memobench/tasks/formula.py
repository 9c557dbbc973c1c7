"""Formulas of goals and checkpoints: trees of atoms under ``And``, ``Or``, ``Not`` and ``Then``.

What an atom means is the world's business; what operators and latches (``wasopen``, ``wasturnedon``) mean over time
is `tasks.evaluator`'s. Here stand the words of the language, how formulas are made, walked through and written.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest

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
}

#: Latched predicate -> the predicate of the world that sets it.
LATCHES: dict[str, str] = {"wasopen": "open", "wasturnedon": "turnon"}

#: Formulas deeper than this are refused (no task comes near; it keeps recursion bounded on malformed files).
MAX_DEPTH = 40


@dataclass(frozen=True)
class Atom:
    """A predicate (lower case, a key of ``PREDICATES``) applied to entity names."""

    predicate: str
    args: tuple[str, ...]

    def __str__(self) -> str:
        return format_formula(self)


@dataclass(frozen=True)
class And:
    """True when all children are; every child is evaluated at every step."""

    children: tuple[Formula, ...]


@dataclass(frozen=True)
class Or:
    """True when some child is; every child is evaluated at every step."""

    children: tuple[Formula, ...]


@dataclass(frozen=True)
class Not:
    """True when the child is not."""

    child: Formula


@dataclass(frozen=True)
class Then:
    """True once the children have been done in order, and from then on; see ``Evaluator``."""

    children: tuple[Formula, ...]


Formula = Atom | And | Or | Not | Then

#: Word (lower case) -> operator; its class's name is the spelling in BDDL.
OPERATORS: dict[str, type[And] | type[Or] | type[Not] | type[Then]] = {"and": And, "or": Or, "not": Not, "then": Then}


# --- making ---


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


def is_operator(word: str) -> bool:
    """Return whether ``word`` is And, Or, Not or Then in any case."""
    return word.lower() in OPERATORS


def make_operator(operator: str, parts: Sequence[Formula], where: str = "formula") -> Formula:
    """Return ``operator`` (any case) over its parts; ``Not`` takes one, the others at least one."""
    key = operator.lower()
    if key not in OPERATORS:
        raise MemobenchError(f"{where}: found the operator {operator!r}, {nearest(key, OPERATORS)}")
    made = OPERATORS[key]
    if not parts:
        raise MemobenchError(f"{where}: found {made.__name__} with nothing in it, expected at least one formula")
    if not issubclass(made, Not):
        return made(tuple(parts))
    if len(parts) != 1:
        raise MemobenchError(f"{where}: found Not over {len(parts)} formulas, expected exactly one")
    return Not(parts[0])


# --- walking ---


def children(formula: Formula) -> tuple[Formula, ...]:
    """Return the direct parts of ``formula`` (none for an atom)."""
    if isinstance(formula, Atom):
        return ()
    return (formula.child,) if isinstance(formula, Not) else formula.children


def atoms(formula: Formula) -> Iterator[Atom]:
    """Yield the atoms of ``formula`` from left to right, repeated ones as often as they occur."""
    if isinstance(formula, Atom):
        yield formula
    for child in children(formula):
        yield from atoms(child)


def rename(formula: Formula, names: Mapping[str, str]) -> Formula:
    """Return ``formula`` with entity names replaced, all at once (so ``{"a": "b", "b": "a"}`` swaps)."""
    if isinstance(formula, Atom):
        return Atom(formula.predicate, tuple(names.get(arg, arg) for arg in formula.args))
    if isinstance(formula, Not):
        return Not(rename(formula.child, names))
    return type(formula)(tuple(rename(child, names) for child in formula.children))


# --- writing ---


def to_lists(formula: Formula) -> list[Any]:
    """Return ``formula`` as nested lists of lower-case words: the inverse of ``parse_formula``."""
    if isinstance(formula, Atom):
        return [formula.predicate, *formula.args]
    return [type(formula).__name__.lower(), *(to_lists(child) for child in children(formula))]


def format_formula(formula: Formula) -> str:
    """Return ``formula`` in BDDL on one line, e.g. ``(And (On a b) (Not (Open c)))``."""
    if isinstance(formula, Atom):
        return f"({PREDICATES[formula.predicate][0]} {' '.join(formula.args)})"
    inside = " ".join(format_formula(child) for child in children(formula))
    return f"({type(formula).__name__} {inside})"
