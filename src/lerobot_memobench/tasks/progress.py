"""Evaluate formulas over time, and track an episode: its goal, and the steps at which checkpoints are satisfied.

Independent of the simulator: `Evaluator.step` calls ``holds(atom)``. One stateful node per node of a formula's tree
implements its operator. Semantics: the benchmark's task files (BDDL and metadata), the paper's section on executable
checkpoints, and ``docs/benchmark/formulas.md``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from lerobot_memobench.tasks.formula import (
    LATCHES,
    And,
    Atom,
    Counted,
    Exactly,
    Formula,
    Hold,
    Never,
    Not,
    Or,
    Round,
    Then,
    When,
    atoms,
    children,
    walk,
)
from lerobot_memobench.tasks.task import Task

#: Consecutive evaluations for which a child of ``Then`` must hold before it is done. There is one evaluation per
#: control step; the authors' code makes two.
HOLD_STEPS = 10
AS_BEGUN = Atom("asbegun", ())


# --- operators over time ---

Read = Callable[[Atom], bool]  # returns the value of an atom in the present step, including latched atoms


class _Node:
    """State of one node of a formula's tree, at first that before any step."""

    def __init__(self, formula: Formula, hold_steps: int) -> None:
        self.formula, self.hold_steps = formula, hold_steps
        self.number = formula.number if isinstance(formula, Counted) else hold_steps
        self.parts = self._new_parts()

    def _new_parts(self) -> list[_Node]:
        return [_NODES[type(child)](child, self.hold_steps) for child in children(self.formula)]

    def value(self, read: Read) -> bool:
        """Advance one step and return the value."""
        raise NotImplementedError

    @property
    def settled(self) -> bool | None:
        """Value at all later steps, None while undecided. Sound, not complete: it may be reported late."""
        raise NotImplementedError


class _AtomNode(_Node):
    """Present value of an atom; a latched atom settles once it is set."""

    latched = False

    def value(self, read: Read) -> bool:
        assert isinstance(self.formula, Atom)
        now = read(self.formula)
        self.latched = now and self.formula.predicate in LATCHES
        return now

    @property
    def settled(self) -> bool | None:
        return True if self.latched else None


# --- And, Or, Not: stateless. Every part is evaluated in every step because a nested operator must see each step ---


class _AndNode(_Node):
    deciding = False  # value of a part that decides the whole

    def value(self, read: Read) -> bool:
        values = [part.value(read) for part in self.parts]
        return (self.deciding in values) == self.deciding

    @property
    def settled(self) -> bool | None:
        values = [part.settled for part in self.parts]
        return self.deciding if self.deciding in values else None if None in values else not self.deciding


class _OrNode(_AndNode):
    deciding = True


class _NotNode(_Node):
    def value(self, read: Read) -> bool:
        return not self.parts[0].value(read)

    @property
    def settled(self) -> bool | None:
        value = self.parts[0].settled
        return None if value is None else not value


# --- Never, Hold, Exactly: durations and counts ---


class _NeverNode(_Node):
    broken = False

    def value(self, read: Read) -> bool:
        now = self.parts[0].value(read)
        self.broken = self.broken or now
        return not self.broken

    @property
    def settled(self) -> bool | None:
        return False if self.broken else True if self.parts[0].settled is False else None


class _HoldNode(_Node):
    held = 0

    def value(self, read: Read) -> bool:
        self.held = min(self.held + 1, self.number) if self.parts[0].value(read) else 0
        return self.held == self.number

    @property
    def settled(self) -> bool | None:
        value = self.parts[0].settled
        return None if value and self.held < self.number else value


class _ExactlyNode(_Node):
    count, before = 0, False

    def value(self, read: Read) -> bool:
        now = self.parts[0].value(read)
        self.count = min(self.count + (now and not self.before), self.number + 1)
        self.before = now
        return self.count == self.number

    @property
    def settled(self) -> bool | None:
        if self.count > self.number:
            return False
        value = self.parts[0].settled
        return self.count == self.number if value is not None and value == self.before else None


# --- Then, Round, When: order of events ---


class _ThenNode(_Node):
    done, held = 0, 0

    def value(self, read: Read) -> bool:
        if self.done < len(self.parts):
            self.held = self.held + 1 if self.parts[self.done].value(read) else 0
            if self.held >= self.number:
                self.done, self.held = self.done + 1, 0
        return self.done == len(self.parts)

    @property
    def settled(self) -> bool | None:
        if self.done == len(self.parts):
            return True
        return False if any(part.settled is False for part in self.parts[self.done :]) else None


class _RoundNode(_Node):
    """Evaluate the next part from the following step; forget all parts' states after a complete round."""

    done = 0

    def value(self, read: Read) -> bool:
        self.done += self.parts[self.done].value(read)
        complete = self.done == len(self.parts)
        if complete:
            self.done, self.parts = 0, self._new_parts()
        return complete

    @property
    def settled(self) -> bool | None:
        return False if any(part.settled is False for part in self.parts[self.done :]) else None


class _WhenNode(_Node):
    decided: bool | None = None

    def value(self, read: Read) -> bool:
        condition, outcome = [part.value(read) for part in self.parts]
        if self.decided is None and condition:
            self.decided = outcome
        return self.decided is True

    @property
    def settled(self) -> bool | None:
        if self.decided is not None:
            return self.decided
        return False if any(part.settled is False for part in self.parts) else None


_NODES: dict[type[Formula], type[_Node]] = {
    Atom: _AtomNode,
    And: _AndNode,
    Or: _OrNode,
    Not: _NotNode,
    Never: _NeverNode,
    Hold: _HoldNode,
    Exactly: _ExactlyNode,
    Then: _ThenNode,
    When: _WhenNode,
    Round: _RoundNode,
}


# --- formulas and episodes ---


class Evaluator:
    """Evaluate several formulas once per control step and keep their state.

    Latches of all formulas are updated first, whether or not their formula evaluates them. A child of ``Then`` is done
    after it has held for ``hold_steps`` consecutive steps, and stays done. The following child is evaluated from the
    next step. ``Then`` is true when its last child is done; a nested one must itself be true for ``hold_steps`` steps.
    """

    def __init__(self, formulas: Iterable[Formula], hold_steps: int = HOLD_STEPS) -> None:
        self.formulas = tuple(formulas)
        self._nodes = [_NODES[type(formula)](formula, hold_steps) for formula in self.formulas]
        latches = {atom for formula in self.formulas for atom in atoms(formula) if atom.predicate in LATCHES}
        self._sources = {atom: Atom(LATCHES[atom.predicate], atom.args) for atom in sorted(latches, key=str)}
        self._latched: set[Atom] = set()

    @property
    def latched(self) -> frozenset[Atom]:
        """The latched atoms that are set."""
        return frozenset(self._latched)

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

    Steps count from 1. With two ``evaluations`` per control step, each part of `Then` has to hold for five steps.
    """

    def __init__(self, task: Task, evaluations: int = 1) -> None:
        self.task, self._evaluations = task, evaluations
        goals = [task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)]
        parts = {part for k in range(task.num_variants) for part in walk(task.variant(k).goal)}
        # Rounds that begin in any scene; those with `AS_BEGUN` begin in the scene of the start only.
        events = [part for part in parts if isinstance(part, Round) and AS_BEGUN not in part.children]
        self._evaluator = Evaluator([*goals, *events])
        count = len(task.checkpoints)
        self.steps = 0
        self.success = False  # whether the goal holds now
        self.event = False  # whether a round from any scene, of any variant's goal, was completed in this step
        self.satisfied: tuple[bool, ...] = (False,) * count  # whether each checkpoint's predicate holds now
        self.first_step: list[int | None] = [None] * count  # step at which the predicate first held
        # Step at which it first held after all earlier checkpoints; several may complete in one step.
        self.ordered_step: list[int | None] = [None] * count
        self.index = 0  # number of checkpoints completed in order

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
