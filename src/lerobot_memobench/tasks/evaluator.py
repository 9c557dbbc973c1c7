"""What formulas mean over time: latches, and the order and hold of ``Then``.

Nothing of a simulator: `Evaluator.step` asks ``holds(atom)``. Semantics: the benchmark's task files (BDDL goals and
metadata goals), paper section on executable checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

from lerobot_memobench.tasks.formula import LATCHES, And, Atom, Formula, Not, Or, Then, atoms, children

#: Consecutive control steps for which a child of ``Then`` must hold before it counts as done.
HOLD_STEPS = 10

_Read = Callable[[Atom], bool]


class _Node:
    """One place in a formula's tree, with what it remembers of earlier steps."""

    def __init__(self, parts: Sequence[_Node] = ()) -> None:
        self.parts = parts

    def reset(self) -> None:
        """Forget earlier steps."""
        for part in self.parts:
            part.reset()

    def value(self, read: _Read) -> bool:
        """Take one step and return what is true in it; ``read`` answers atoms."""
        raise NotImplementedError


class _AtomNode(_Node):
    def __init__(self, atom: Atom) -> None:
        super().__init__()
        self.atom = atom

    def value(self, read: _Read) -> bool:
        return read(self.atom)


class _GateNode(_Node):
    """And, Or and Not. Lists, not generators: a nested ``Then`` must see every step."""

    def __init__(self, parts: Sequence[_Node], gate: Callable[[list[bool]], bool]) -> None:
        super().__init__(parts)
        self.gate = gate

    def value(self, read: _Read) -> bool:
        return self.gate([part.value(read) for part in self.parts])


class _ThenNode(_Node):
    """Counts how long the current child has held; the next child is first looked at in the step after."""

    def __init__(self, parts: Sequence[_Node], hold_steps: int) -> None:
        super().__init__(parts)
        self.hold_steps = hold_steps
        self.done = self.held = 0

    def reset(self) -> None:
        super().reset()
        self.done = self.held = 0

    def value(self, read: _Read) -> bool:
        if self.done < len(self.parts):
            self.held = self.held + 1 if self.parts[self.done].value(read) else 0
            if self.held >= self.hold_steps:
                self.done, self.held = self.done + 1, 0
        return self.done == len(self.parts)


_GATES: dict[type, Callable[[list[bool]], bool]] = {And: all, Or: any, Not: lambda values: not values[0]}


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
        return _GateNode(parts, _GATES[type(formula)])

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
