"""Formulas evaluated step by step, with latches; what the operators mean over time is `tasks.nodes`'s.

Nothing of a simulator: `Evaluator.step` asks ``holds(atom)``. Semantics: the benchmark's task files (BDDL goals and
metadata goals), paper section on executable checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from lerobot_memobench.tasks.formula import LATCHES, Atom, Formula, atoms
from lerobot_memobench.tasks.nodes.build import build

#: Consecutive control steps for which a child of ``Then`` must hold before it counts as done.
HOLD_STEPS = 10


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
        self._nodes = [build(formula, hold_steps) for formula in self.formulas]
        self._remembering = [node for root in self._nodes for node in root.walk() if node.memory]
        found = {atom for formula in self.formulas for atom in atoms(formula) if atom.predicate in LATCHES}
        self._sources = {atom: Atom(LATCHES[atom.predicate], atom.args) for atom in sorted(found, key=str)}
        self._latched: set[Atom] = set()

    def reset(self) -> None:
        """Forget all earlier steps."""
        self._latched.clear()
        for node in self._nodes:
            node.reset()

    @property
    def latched(self) -> frozenset[Atom]:
        """The latched atoms that are set."""
        return frozenset(self._latched)

    @property
    def memory(self) -> tuple[frozenset[Atom], tuple[tuple[int, ...], ...]]:
        """What of earlier steps decides later values: latches, and what each operator remembers. Hashable."""
        return self.latched, tuple(node.memory for node in self._remembering)

    @property
    def settled(self) -> tuple[bool | None, ...]:
        """Per formula the value that it has at every later step, whatever happens; None while that is open."""
        return tuple(node.settled for node in self._nodes)

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
