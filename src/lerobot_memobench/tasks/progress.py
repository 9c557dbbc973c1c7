"""Follow an episode step by step: which checkpoints were satisfied when, and whether the goal holds.

Nothing of a simulator: `Evaluator.step` asks ``holds(atom)``. `tasks.nodes` says what operators mean over time.
Semantics: the benchmark's task files (BDDL goals and metadata goals), paper section on executable checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from lerobot_memobench.tasks.formula import LATCHES, Atom, Formula, atoms
from lerobot_memobench.tasks.nodes import build
from lerobot_memobench.tasks.task import Task

#: Consecutive evaluations, of which a control step has one, for which a child of ``Then`` must hold before it counts as
#: done. The authors' evaluation has two per control step.
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


class Progress:
    """Follows one episode's execution phase; call ``step`` exactly once per control step.

    Args:
        task: with goal and checkpoints.
        evaluations: of the formulas per control step; with two, each part of `Then` has to hold for five steps.

    Attributes (steps are counted from 1; None until it happens; K checkpoints):
        steps: control steps taken since ``reset``.
        success: the goal holds now.
        satisfied: (K,) the checkpoint's predicate holds now.
        first_step: (K,) first step at which the predicate held.
        ordered_step: (K,) first step at which it held with all earlier checkpoints complete in order; several
            may complete in one step.
        index: number of checkpoints completed in order so far.
    """

    def __init__(self, task: Task, evaluations: int = 1) -> None:
        self.task, self._evaluations = task, evaluations
        self._evaluator = Evaluator([task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)])
        self.reset()

    def reset(self) -> None:
        """Forget everything: the execution starts anew."""
        self._evaluator.reset()
        count = len(self.task.checkpoints)
        self.steps = 0
        self.success = False
        self.satisfied: tuple[bool, ...] = (False,) * count
        self.first_step: list[int | None] = [None] * count
        self.ordered_step: list[int | None] = [None] * count
        self.index = 0

    @property
    def lost(self) -> bool:
        """The goal can no longer be reached, whatever is done."""
        return self._evaluator.settled[0] is False

    def settle(self, holds: Callable[[Atom], bool]) -> None:
        """Take in the state after a control step before the execution: formulas see it, nothing is counted."""
        for _ in range(self._evaluations):
            self._evaluator.step(holds)

    def step(self, holds: Callable[[Atom], bool]) -> bool:
        """Take in the state after one control step, answered by ``holds``; return ``success``."""
        self.steps += 1
        for _ in range(self._evaluations):
            self.success, *satisfied = self._evaluator.step(holds)
        self.satisfied = tuple(satisfied)
        for k, now in enumerate(satisfied):
            if now and self.first_step[k] is None:
                self.first_step[k] = self.steps
        while self.index < len(satisfied) and satisfied[self.index]:
            self.ordered_step[self.index] = self.steps
            self.index += 1
        return self.success
