"""An explored scene as a graph of states and answers, and what a goal remembers along its moves. Pure: no simulator."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field

from lerobot_memobench.tasks.evaluator import Evaluator
from lerobot_memobench.tasks.formula import Atom, Formula


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
    """Explored part of a scene; node 0 is the start. A node without moves was not explored further.

    Attributes:
        pictures: class of what is seen, per node.
        moves: node → answer → move.
    """

    pictures: list[int]
    moves: dict[int, dict[str, Move]] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Every node was explored."""
        return all(node in self.moves for node in range(len(self.pictures)))

    @property
    def answers(self) -> list[str]:
        """Every answer of some node, sorted."""
        return sorted({answer for moves in self.moves.values() for answer in moves})


class GoalWatch:
    """Follows one goal along moves; what it remembers is numbered, 0 at the start of the execution."""

    def __init__(self, goal: Formula) -> None:
        start = Evaluator([goal])
        self._evaluators = [start]
        self._numbers = {start.memory: 0}
        self._known: dict[tuple[int, int], tuple[int, int | None]] = {}

    def advance(self, memory: int, move: Move) -> tuple[int, int | None]:
        """Return the memory after a move, and at which of its steps the goal first held (from 1; None: never)."""
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
        number = self._numbers.setdefault(evaluator.memory, len(self._evaluators))
        if number == len(self._evaluators):
            self._evaluators.append(evaluator)
        return number, None
