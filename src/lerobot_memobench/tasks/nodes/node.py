"""What all nodes can do, and the node of an atom."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import override

from lerobot_memobench.tasks.formula import LATCHES, Atom

Read = Callable[[Atom], bool]
"""Answers atoms about the present step, latched ones included."""


class Node:
    """One place in a formula's tree.

    Attributes:
        settled: the value that the node has at every later step, whatever happens; None while it is open. Never
            wrong, though not always found as early as could be.
    """

    def __init__(self, parts: Sequence[Node] = ()) -> None:
        self.parts = parts

    def reset(self) -> None:
        """Forget earlier steps."""
        for part in self.parts:
            part.reset()

    def value(self, read: Read) -> bool:
        """Take one step and return what is true in it; ``read`` answers atoms."""
        raise NotImplementedError

    @property
    def settled(self) -> bool | None:
        """See the class."""
        raise NotImplementedError

    @property
    def memory(self) -> tuple[int, ...]:
        """What of earlier steps decides later values, of this node alone."""
        return ()

    def walk(self) -> Iterator[Node]:
        """Yield this node and all below it."""
        yield self
        for part in self.parts:
            yield from part.walk()


class AtomNode(Node):
    """What the world, or a latch, says now."""

    def __init__(self, atom: Atom) -> None:
        super().__init__()
        self.atom = atom
        self.latched = False

    @override
    def reset(self) -> None:
        self.latched = False

    @override
    def value(self, read: Read) -> bool:
        now = read(self.atom)
        self.latched = now and self.atom.predicate in LATCHES
        return now

    @property
    @override
    def settled(self) -> bool | None:
        return True if self.latched else None
