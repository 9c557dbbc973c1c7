"""Formulas of goals and checkpoints: trees of atoms under operators, the published four and the strict suite's five.

What an atom means is the world's business; what operators and latches (``wasopen``, ``wasturnedon``) mean over time
is `tasks.nodes`'s (the table is in ``docs/formulas.md``). Here stand the words of the language, how formulas are
walked through and written; `tasks.formula_making` makes checked ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

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
    "inplace": ("InPlace", 1),
}

#: Latched predicate -> the predicate of the world that sets it.
LATCHES: dict[str, str] = {"wasopen": "open", "wasturnedon": "turnon"}

#: Predicates that compare the present with how the execution began; they say nothing of a starting state.
SINCE_START = frozenset({"handhome", "inplace"})

#: Largest number in a formula: more steps than any episode has.
MAX_NUMBER = 100_000

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


@dataclass(frozen=True)
class Never:
    """True as long as the child has not been true in any step so far; false for good from then on."""

    child: Formula


@dataclass(frozen=True)
class Hold:
    """True when the child has been true in each of the last ``number`` steps, the present one included."""

    number: int
    child: Formula


@dataclass(frozen=True)
class Exactly:
    """True while the child has come true (after a step in which it was false, or at first) ``number`` times so far."""

    number: int
    child: Formula


@dataclass(frozen=True)
class When:
    """Of two children, the first moment of the first decides: true from then on if the second is true in that step.

    False before; false for good when the second is false in that step.
    """

    children: tuple[Formula, ...]


@dataclass(frozen=True)
class Round:
    """True in the step in which the last child comes true after the ones before it, in order; then it begins anew."""

    children: tuple[Formula, ...]


Counted = Hold | Exactly
Formula = Atom | And | Or | Not | Then | Never | Hold | Exactly | When | Round

_OPERATORS = (And, Or, Not, Then, Never, Hold, Exactly, When, Round)
#: Word (lower case) -> operator; its class's name is the spelling in BDDL.
OPERATORS: dict[str, type[Formula]] = {made.__name__.lower(): made for made in _OPERATORS}


def is_operator(word: str) -> bool:
    """Return whether ``word`` is an operator's, in any case."""
    return word.lower() in OPERATORS


def takes_number(word: str) -> bool:
    """Return whether ``word`` is an operator whose formula follows a number, such as ``Exactly 2``."""
    return word.lower() in ("hold", "exactly")


# --- walking ---


def children(formula: Formula) -> tuple[Formula, ...]:
    """Return the direct parts of ``formula`` (none for an atom)."""
    if isinstance(formula, Atom):
        return ()
    return (formula.child,) if isinstance(formula, Not | Never | Hold | Exactly) else formula.children


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
    if isinstance(formula, Not | Never | Hold | Exactly):
        return replace(formula, child=rename(formula.child, names))
    return replace(formula, children=tuple(rename(child, names) for child in formula.children))


# --- writing ---


def to_lists(formula: Formula) -> list[Any]:
    """Return ``formula`` as nested lists of lower-case words: the inverse of ``parse_formula``."""
    if isinstance(formula, Atom):
        return [formula.predicate, *formula.args]
    number = [formula.number] if isinstance(formula, Counted) else []
    return [type(formula).__name__.lower(), *number, *(to_lists(child) for child in children(formula))]


def format_formula(formula: Formula) -> str:
    """Return ``formula`` in BDDL on one line, e.g. ``(And (On a b) (Not (Open c)))``."""
    if isinstance(formula, Atom):
        return f"({' '.join((PREDICATES[formula.predicate][0], *formula.args))})"
    inside = " ".join(format_formula(child) for child in children(formula))
    return f"({head_of(formula)} {inside})"


def head_of(formula: Formula) -> str:
    """Return what stands before an operator's formulas in BDDL, e.g. ``And`` or ``Exactly 2``."""
    word = type(formula).__name__
    return f"{word} {formula.number}" if isinstance(formula, Counted) else word
