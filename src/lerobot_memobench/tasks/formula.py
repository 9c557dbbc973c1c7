"""Formulas of goals and checkpoints: logic and time, nothing of a simulator.

A formula is a tree of atoms under ``And``, ``Or``, ``Not`` and ``Then``. What an atom means is the world's
business; this module asks ``holds(atom)`` and knows the rest: latches (``wasopen``, ``wasturnedon``) and the
order and hold of ``Then``. Semantics: the benchmark's task files (BDDL goals and metadata goals), paper
section on executable checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest

#: Consecutive control steps for which a child of ``Then`` must hold before it counts as done.
HOLD_STEPS = 10

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

_OPERATORS: dict[str, str] = {"and": "And", "or": "Or", "not": "Not", "then": "Then"}


# --- building and reading ---


def make_atom(predicate: str, args: Sequence[str], where: str = "formula") -> Atom:
    """Return a checked atom; ``where`` (file and line) opens the message of a ``MemobenchError``."""
    key = predicate.lower()
    if key not in PREDICATES:
        hint = nearest(key, [*PREDICATES, *_OPERATORS])
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
    return word.lower() in _OPERATORS


def make_operator(operator: str, children: Sequence[Formula], where: str = "formula") -> Formula:
    """Return ``operator`` (any case) over ``children``; ``Not`` takes one child, the others at least one."""
    key = operator.lower()
    if key not in _OPERATORS:
        raise MemobenchError(f"{where}: found the operator {operator!r}, {nearest(key, _OPERATORS)}")
    if not children:
        raise MemobenchError(f"{where}: found {_OPERATORS[key]} with nothing in it, expected at least one formula")
    if key == "not":
        if len(children) != 1:
            raise MemobenchError(f"{where}: found Not over {len(children)} formulas, expected exactly one")
        return Not(children[0])
    kinds: dict[str, type[And] | type[Or] | type[Then]] = {"and": And, "or": Or, "then": Then}
    return kinds[key](tuple(children))


def parse_formula(value: Any, where: str = "formula") -> Formula:
    """Read a formula from nested lists or JSON objects.

    ``["And", ["On", "a", "b"]]`` and ``{"and": [["on", "a", "b"]]}`` are the same. Words are read in any
    case, the two shapes may be mixed, and an operator may hold a bare atom instead of a list. Raises
    ``MemobenchError`` whose message starts with ``where``.
    """
    return _parse(value, where, 0)


def _parse(value: Any, where: str, depth: int) -> Formula:
    if depth > MAX_DEPTH:
        raise MemobenchError(f"{where}: found a formula nested deeper than {MAX_DEPTH} levels, expected a flatter one")
    if isinstance(value, Mapping):
        if len(value) != 1:
            raise MemobenchError(
                f"{where}: found an object with {len(value)} keys, expected one of 'and', 'or', 'not', 'then'"
            )
        ((head, rest),) = value.items()
        if not isinstance(head, str) or not is_operator(head):
            raise MemobenchError(f"{where}: found the key {head!r}, expected one of 'and', 'or', 'not', 'then'")
        # {"not": ["on", "a", "b"]} and {"not": {"and": ...}} hold one formula, not a list of them.
        bare = isinstance(rest, Mapping) or (isinstance(rest, (list, tuple)) and rest and isinstance(rest[0], str))
        items = [rest] if bare else rest
        if not isinstance(items, (list, tuple)):
            raise MemobenchError(f"{where}: found {_short(rest)} under {head!r}, expected a list of formulas")
    elif isinstance(value, (list, tuple)) and value and isinstance(value[0], str):
        head, items = value[0], list(value[1:])
    else:
        raise MemobenchError(f"{where}: found {_short(value)}, expected a formula such as ['on', 'a', 'b']")
    if is_operator(head):
        return make_operator(head, [_parse(item, where, depth + 1) for item in items], where)
    for item in items:
        if not isinstance(item, str) or not item:
            raise MemobenchError(f"{where}: found {_short(item)} as an argument of {head!r}, expected an entity name")
    return make_atom(head, items, where)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else text[:37] + "..."


def to_lists(formula: Formula) -> list[Any]:
    """Return ``formula`` as nested lists of lower-case words: the inverse of ``parse_formula``."""
    if isinstance(formula, Atom):
        return [formula.predicate, *formula.args]
    if isinstance(formula, Not):
        return ["not", to_lists(formula.child)]
    return [type(formula).__name__.lower(), *(to_lists(child) for child in formula.children)]


def format_formula(formula: Formula) -> str:
    """Return ``formula`` in BDDL on one line, e.g. ``(And (On a b) (Not (Open c)))``."""
    if isinstance(formula, Atom):
        return f"({PREDICATES[formula.predicate][0]} {' '.join(formula.args)})"
    inside = " ".join(format_formula(child) for child in children(formula))
    return f"({type(formula).__name__} {inside})"


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


# --- evaluation over time ---

_Read = Callable[[Atom], bool]


class _AtomNode:
    def __init__(self, atom: Atom) -> None:
        self.atom = atom

    def reset(self) -> None:
        pass

    def value(self, read: _Read) -> bool:
        return read(self.atom)


class _GateNode:
    """And, Or and Not. Lists, not generators: a nested ``Then`` must see every step."""

    def __init__(self, parts: list[_Node], gate: Callable[[list[bool]], bool]) -> None:
        self.parts, self.gate = parts, gate

    def reset(self) -> None:
        for part in self.parts:
            part.reset()

    def value(self, read: _Read) -> bool:
        return self.gate([part.value(read) for part in self.parts])


class _ThenNode:
    """Counts how long the current child has held; the next child is first looked at in the step after."""

    def __init__(self, parts: list[_Node], hold_steps: int) -> None:
        self.parts, self.hold_steps = parts, hold_steps
        self.done = self.held = 0

    def reset(self) -> None:
        self.done = self.held = 0
        for part in self.parts:
            part.reset()

    def value(self, read: _Read) -> bool:
        if self.done < len(self.parts):
            self.held = self.held + 1 if self.parts[self.done].value(read) else 0
            if self.held >= self.hold_steps:
                self.done, self.held = self.done + 1, 0
        return self.done == len(self.parts)


_Node = _AtomNode | _GateNode | _ThenNode


class Evaluator:
    """Evaluates formulas together, once per control step, with their memory of earlier steps.

    - ``holds`` is asked at most once per distinct atom and step, and never about a latched predicate.
    - Latches are brought up to date first, for every latched atom of every formula, looked at or not; they
      stay until ``reset``.
    - A child of ``Then`` is done once it has held for ``hold_steps`` consecutive steps; only then (from the
      next step on) the following child is looked at; done stays done. ``Then`` is true when its last child is
      done. A nested ``Then`` is a child like any other: it has to have been true for ``hold_steps`` steps
      itself.
    """

    def __init__(self, formulas: Iterable[Formula], hold_steps: int = HOLD_STEPS) -> None:
        self.formulas = tuple(formulas)
        self._thens: list[_ThenNode] = []
        self._nodes = [self._build(formula, hold_steps) for formula in self.formulas]
        found = {atom for formula in self.formulas for atom in atoms(formula) if atom.predicate in LATCHES}
        self._sources = {atom: Atom(LATCHES[atom.predicate], atom.args) for atom in sorted(found, key=str)}
        self._latched: set[Atom] = set()

    def _build(self, formula: Formula, hold_steps: int) -> _Node:
        if isinstance(formula, Atom):
            return _AtomNode(formula)
        parts = [self._build(child, hold_steps) for child in children(formula)]
        if isinstance(formula, Then):
            self._thens.append(_ThenNode(parts, hold_steps))
            return self._thens[-1]
        gates: dict[type, Callable[[list[bool]], bool]] = {
            And: all,
            Or: any,
            Not: lambda values: not values[0],
        }
        return _GateNode(parts, gates[type(formula)])

    def reset(self) -> None:
        """Forget latches and ``Then`` progress."""
        self._latched.clear()
        for node in self._nodes:
            node.reset()

    @property
    def latched(self) -> frozenset[Atom]:
        """The latched atoms that are set."""
        return frozenset(self._latched)

    @property
    def memory(self) -> tuple[frozenset[Atom], tuple[tuple[int, int], ...]]:
        """What of earlier steps decides later values: latches, and how far each ``Then`` has come. Hashable."""
        return self.latched, tuple((node.done, node.held) for node in self._thens)

    def step(self, holds: Callable[[Atom], bool]) -> tuple[bool, ...]:
        """Take one control step of the world, answered by ``holds``, and return the value of each formula."""
        memo: dict[Atom, bool] = {}

        def world(atom: Atom) -> bool:
            if atom not in memo:
                memo[atom] = bool(holds(atom))
            return memo[atom]

        for latch, source in self._sources.items():
            if latch not in self._latched and world(source):
                self._latched.add(latch)

        def read(atom: Atom) -> bool:
            return atom in self._latched if atom.predicate in LATCHES else world(atom)

        return tuple(node.value(read) for node in self._nodes)
