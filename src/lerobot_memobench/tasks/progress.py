"""Track an episode step by step: steps at which checkpoints are satisfied, and the value of the goal.

Independent of the simulator: `Evaluator.step` calls ``holds(atom)``. `tasks.nodes` implements operators over time.
Semantics: the benchmark's task files (BDDL goals and metadata goals), paper section on executable checkpoints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from lerobot_memobench.tasks.formula import LATCHES, And, Atom, Formula, Round, When, atoms, children, walk
from lerobot_memobench.tasks.nodes import build_tree
from lerobot_memobench.tasks.task import Task

#: Consecutive evaluations for which a child of ``Then`` must hold before it is done. There is one evaluation per
#: control step; the authors' code makes two.
HOLD_STEPS = 10
AS_BEGUN = Atom("asbegun", ())


class Evaluator:
    """Evaluate several formulas once per control step and keep their state.

    Latches of all formulas are updated first, whether or not their formula evaluates them. A child of ``Then`` is done
    after it has held for ``hold_steps`` consecutive steps, and stays done. The following child is evaluated from the
    next step. ``Then`` is true when its last child is done; a nested one must itself be true for ``hold_steps`` steps.
    """

    def __init__(self, formulas: Iterable[Formula], hold_steps: int = HOLD_STEPS) -> None:
        self.formulas = tuple(formulas)
        self._nodes = [build_tree(formula, hold_steps) for formula in self.formulas]
        self._remembering = [node for root in self._nodes for node in root.walk() if node.memory]
        latches = {atom for formula in self.formulas for atom in atoms(formula) if atom.predicate in LATCHES}
        self._sources = {atom: Atom(LATCHES[atom.predicate], atom.args) for atom in sorted(latches, key=str)}
        self._latched: set[Atom] = set()

    def reset(self) -> None:
        """Clear the state of all formulas."""
        self._latched.clear()
        for node in self._nodes:
            node.reset()

    @property
    def latched(self) -> frozenset[Atom]:
        """The latched atoms that are set."""
        return frozenset(self._latched)

    @property
    def memory(self) -> tuple[frozenset[Atom], tuple[tuple[int, ...], ...]]:
        """State that determines later values: latches and operator states. Hashable."""
        return self.latched, tuple(node.memory for node in self._remembering)

    @property
    def settled(self) -> tuple[bool | None, ...]:
        """Per formula its value at all later steps, whatever happens; None while undecided."""
        return tuple(node.settled for node in self._nodes)

    def parts(self, k: int) -> list[tuple[Formula, bool | None]]:
        """Return the parts of formula ``k``, if it is a conjunction, else itself, each with its settled value."""
        formula, node = self.formulas[k], self._nodes[k]
        if not isinstance(formula, And):
            return [(formula, node.settled)]
        return [(part, child.settled) for part, child in zip(children(formula), node.parts, strict=True)]

    def step(self, holds: Callable[[Atom], bool]) -> tuple[bool, ...]:
        """Evaluate one control step and return the value of each formula.

        ``holds`` is called at most once per distinct atom, and never for a latched predicate.
        """
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
    """Track the execution phase of one episode; call ``step`` exactly once per control step.

    With two ``evaluations`` per control step, each part of `Then` has to hold for five steps.

    Attributes (steps count from 1, None before the event; K checkpoints):
        steps: control steps taken since ``reset``.
        success: whether the goal holds now.
        event: whether an event was completed in this step: a `Round` from any scene, of any variant's goal.
        satisfied: (K,) whether the checkpoint's predicate holds now.
        first_step: (K,) first step at which the predicate held.
        ordered_step: (K,) first step at which it held after all earlier checkpoints were completed in order; several
            may complete in one step.
        index: number of checkpoints completed in order.
    """

    def __init__(self, task: Task, evaluations: int = 1) -> None:
        self.task, self._evaluations = task, evaluations
        goals = [task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)]
        parts = {part for k in range(task.num_variants) for part in walk(task.variant(k).goal)}
        # Rounds that begin in any scene; those with `AS_BEGUN` begin in the scene of the start only.
        events = [part for part in parts if isinstance(part, Round) and AS_BEGUN not in part.children]
        self._evaluator = Evaluator([*goals, *events])
        self.reset()

    def reset(self) -> None:
        """Restart the execution: clear all node."""
        self._evaluator.reset()
        count = len(self.task.checkpoints)
        self.steps = 0
        self.success = self.event = False
        self.satisfied: tuple[bool, ...] = (False,) * count
        self.first_step: list[int | None] = [None] * count
        self.ordered_step: list[int | None] = [None] * count
        self.index = 0

    @property
    def broken(self) -> Formula | None:
        """The part of the goal that made it unreachable; None while it is reachable."""
        return next((part for part, settled in self._evaluator.parts(0) if settled is False), None)

    @property
    def ordered(self) -> bool:
        """Whether the goal asks for an order of events, and each event has begun in this order."""
        begun = [settled for part, settled in self._evaluator.parts(0) if isinstance(part, When)]
        return bool(begun) and all(begun)

    @property
    def lost(self) -> bool:
        """Whether the goal can no longer be reached."""
        return self._evaluator.settled[0] is False

    def settle(self, holds: Callable[[Atom], bool]) -> None:
        """Evaluate a state before the execution: it updates latches and operators but no counter."""
        for _ in range(self._evaluations):
            self._evaluator.step(holds)

    def step(self, holds: Callable[[Atom], bool]) -> bool:
        """Evaluate the state after one control step; ``holds`` evaluates atoms. Return ``success``."""
        self.steps += 1
        for _ in range(self._evaluations):
            self.success, *values = self._evaluator.step(holds)
        satisfied, events = values[: len(self.satisfied)], values[len(self.satisfied) :]
        self.satisfied, self.event = tuple(satisfied), any(events)
        for k, now in enumerate(satisfied):
            if now and self.first_step[k] is None:
                self.first_step[k] = self.steps
        while self.index < len(satisfied) and satisfied[self.index]:
            self.ordered_step[self.index] = self.steps
            self.index += 1
        return self.success
