"""An explored scene as a graph of states and answers, and what a goal remembers along its moves. Pure: no simulator."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

from lerobot_memobench.tasks.formula import Atom, Formula
from lerobot_memobench.tasks.progress import Evaluator


@dataclass(frozen=True)
class Move:
    """What an answer does at a node.

    Attributes:
        to: node it leads to.
        steps: control steps it takes.
        trace: (atoms that held, for how many steps), from its first step to its last.
    """

    to: int
    steps: int
    trace: tuple[tuple[frozenset[Atom], int], ...]


@dataclass
class Graph:
    """Explored part of a scene; node 0 is a start. A node without moves was not explored further.

    Attributes:
        pictures: class of what is seen, per node.
        moves: node → answer → move.
        decided: nodes that nobody needs to explore: whichever way they are reached, every goal is reached or lost.
    """

    pictures: list[int]
    moves: dict[int, dict[str, Move]] = field(default_factory=dict)
    decided: set[int] = field(default_factory=set)

    @property
    def complete(self) -> bool:
        """Every node was explored that a goal needs."""
        return all(node in self.moves or node in self.decided for node in range(len(self.pictures)))

    @property
    def answers(self) -> list[str]:
        """Every answer of some node, sorted."""
        return sorted({answer for moves in self.moves.values() for answer in moves})


LOST = -1
"""What a goal remembers once it can no longer be reached."""


class GoalWatch:
    """Follows one goal along moves; what it remembers is numbered, 0 at the start of the execution, or `LOST`."""

    def __init__(self, goal: Formula) -> None:
        start = Evaluator([goal])
        self._evaluators = [start]
        self._numbers = {start.memory: 0}
        self._known: dict[tuple[int, int], tuple[int, int | None]] = {}

    def advance(self, memory: int, move: Move) -> tuple[int, int | None]:
        """Return the memory after a move, and at which of its steps the goal first held (from 1; None: never)."""
        if memory == LOST:
            return LOST, None
        key = (memory, id(move))
        if key not in self._known:
            self._known[key] = self._follow(memory, move)
        return self._known[key]

    def _follow(self, memory: int, move: Move) -> tuple[int, int | None]:
        evaluator = copy.deepcopy(self._evaluators[memory])
        step = 0
        for true, times in move.trace:
            for _ in range(times):
                step += 1
                if evaluator.step(true.__contains__)[0]:
                    return memory, step
        if evaluator.settled[0] is False:
            return LOST, None
        number = self._numbers.setdefault(evaluator.memory, len(self._evaluators))
        if number == len(self._evaluators):
            self._evaluators.append(evaluator)
        return number, None


Memories = tuple[int | None, ...]
"""Per goal what it remembers; None once it held in time."""


def advance_all(watches: Sequence[GoalWatch], memories: Memories, move: Move, left: int | None = None) -> Memories:
    """Return what goals remember after a move for which so many steps were left; None: as many as it takes."""
    found: list[int | None] = []
    for watch, memory in zip(watches, memories, strict=True):
        number, step = (None, None) if memory is None else watch.advance(memory, move)
        found.append(None if step is not None and (left is None or step <= left) else number)
    return tuple(found)


def is_decided(memories: Memories) -> bool:
    """Whether every goal is reached or lost."""
    return all(memory is None or memory == LOST for memory in memories)
