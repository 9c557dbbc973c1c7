"""Evaluate operators over time: one stateful node per node of a formula's tree.

``docs/benchmark/formulas.md`` summarises the semantics.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

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
    children,
)

Read = Callable[[Atom], bool]
"""Returns the value of an atom in the present step, including latched atoms."""


def build_tree(formula: Formula, hold_steps: int) -> _Node:
    """Return the evaluation tree of a formula; ``hold_steps``: steps for which each child of `Then` has to hold."""
    if isinstance(formula, Atom):
        return _AtomNode(formula)
    parts = [build_tree(child, hold_steps) for child in children(formula)]
    number = hold_steps if isinstance(formula, Then) else formula.number if isinstance(formula, Counted) else 0
    return _NODES[type(formula)](parts, number)


class _Node:
    """State of one node of a formula's tree.

    Attributes:
        remembers: names of the attributes that change; the class attributes of these names are the initial values.
        number: number of `Hold` and `Exactly`; for `Then` the steps for which a child has to hold.
    """

    remembers: ClassVar[tuple[str, ...]] = ()

    def __init__(self, parts: Sequence[_Node] = (), number: int = 0) -> None:
        self.parts, self.number = parts, number

    def reset(self) -> None:
        for name in self.remembers:
            setattr(self, name, getattr(type(self), name))
        for part in self.parts:
            part.reset()

    @property
    def memory(self) -> tuple[int, ...]:
        """State of this node, not of its children; -1 for undecided."""
        values = [getattr(self, name) for name in self.remembers]
        return tuple(-1 if value is None else int(value) for value in values)

    def value(self, read: Read) -> bool:
        """Advance one step and return the value."""
        raise NotImplementedError

    @property
    def settled(self) -> bool | None:
        """Value at all later steps, None while undecided. Sound, not complete: it may be reported late."""
        raise NotImplementedError

    def walk(self) -> Iterator[_Node]:
        yield self
        for part in self.parts:
            yield from part.walk()


class _AtomNode(_Node):
    """Present value of an atom; a latched atom settles once it is set."""

    latched = False

    def __init__(self, atom: Atom) -> None:
        super().__init__()
        self.atom = atom

    def reset(self) -> None:
        self.latched = False

    def value(self, read: Read) -> bool:
        now = read(self.atom)
        self.latched = now and self.atom.predicate in LATCHES
        return now

    @property
    def settled(self) -> bool | None:
        return True if self.latched else None


# --- And, Or, Not: stateless. Every part is evaluated in every step because a nested operator must see each step ---


class _AndNode(_Node):
    def value(self, read: Read) -> bool:
        values = [part.value(read) for part in self.parts]
        return all(values)

    @property
    def settled(self) -> bool | None:
        values = [part.settled for part in self.parts]
        return False if False in values else None if None in values else True


class _OrNode(_Node):
    def value(self, read: Read) -> bool:
        values = [part.value(read) for part in self.parts]
        return any(values)

    @property
    def settled(self) -> bool | None:
        values = [part.settled for part in self.parts]
        return True if True in values else None if None in values else False


class _NotNode(_Node):
    def value(self, read: Read) -> bool:
        return not self.parts[0].value(read)

    @property
    def settled(self) -> bool | None:
        value = self.parts[0].settled
        return None if value is None else not value


# --- Never, Hold, Exactly: durations and counts ---


class _NeverNode(_Node):
    remembers = ("broken",)
    broken = False

    def value(self, read: Read) -> bool:
        now = self.parts[0].value(read)
        self.broken = self.broken or now
        return not self.broken

    @property
    def settled(self) -> bool | None:
        return False if self.broken else True if self.parts[0].settled is False else None


class _HoldNode(_Node):
    remembers = ("held",)
    held = 0

    def value(self, read: Read) -> bool:
        self.held = min(self.held + 1, self.number) if self.parts[0].value(read) else 0
        return self.held == self.number

    @property
    def settled(self) -> bool | None:
        value = self.parts[0].settled
        return None if value and self.held < self.number else value


class _ExactlyNode(_Node):
    """True while the part has had ``number`` rising edges; the count saturates at one more."""

    remembers = ("count", "before")
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
    """Count how long the current child has held; evaluate the next child from the following step."""

    remembers = ("done", "held")
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
    """Evaluate the next part from the following step; reset all parts after a complete round."""

    remembers = ("done",)
    done = 0

    def value(self, read: Read) -> bool:
        self.done += self.parts[self.done].value(read)
        complete = self.done == len(self.parts)
        if complete:
            self.reset()
        return complete

    @property
    def settled(self) -> bool | None:
        return False if any(part.settled is False for part in self.parts[self.done :]) else None


class _WhenNode(_Node):
    """Latch the second part's value in the first step in which the first part is true."""

    remembers = ("decided",)
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
