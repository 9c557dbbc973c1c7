"""What else could be done than what the expert does? Every answer is tried at every state that can be reached."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING

from lerobot_memobench.evaluation.necessity.graph import (
    GoalWatch,
    Graph,
    Memories,
    Move,
    advance_all,
    is_decided,
)
from lerobot_memobench.evaluation.necessity.home import SETTLE
from lerobot_memobench.evaluation.necessity.laboratory import Laboratory, Place
from lerobot_memobench.evaluation.necessity.pictures import Picture, photograph
from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Snapshot


@dataclass
class Exploration:
    """What was found.

    Attributes:
        graph: states and moves; pictures are numbered by node until somebody groups them.
        starts: node at which each goal's execution begins.
        pictures: what is seen at each node. true: which atoms of the goals hold there.
        moves, steps: how many of either were simulated.
        exhausted: no state is left that can be reached before the horizon and matters; the budget cut nothing off.
    """

    graph: Graph
    pictures: list[tuple[Picture, ...]]
    true: list[frozenset[Atom]]
    starts: list[int]
    moves: int = 0
    steps: int = 0
    exhausted: bool = False


def explore(laboratory: Laboratory, budget: int, horizon: int = HORIZON) -> Exploration:
    """Try every answer at every state that can be reached before the horizon, nearest states first.

    States in which every goal is reached or lost are left alone.

    Args:
        budget: control steps after which no further state is begun; those that are left stay without moves. Starts that
            differ have one each.
    """
    explorer = _Explorer(laboratory, horizon)
    budget *= len(set(explorer.found.starts))
    while (node := explorer.nearest()) is not None and explorer.found.steps < budget:
        explorer.expand(node)
    explorer.found.exhausted = node is None
    return explorer.found


class _Explorer:
    """Grows an exploration state by state; it begins with the starts.

    Attributes:
        found: what is known so far.
    """

    def __init__(self, laboratory: Laboratory, horizon: int) -> None:
        self._laboratory, self._horizon = laboratory, horizon
        self._watches = [GoalWatch(task.goal) for task in laboratory.variants]
        self._snapshots: list[Snapshot] = []
        self._places: list[Place] = []
        self._cost: list[int] = []
        """Least control steps known in which each node is reached."""
        self.found = Exploration(Graph([]), [], [], [])
        for start in laboratory.starts:
            laboratory.sim.restore(start)
            self.found.starts.append(self._reach(0))

    def nearest(self) -> int | None:
        """Return the node that is reached soonest of those that are not explored and lie before the horizon."""
        graph = self.found.graph
        graph.decided = set(range(len(self._cost))) - self._undecided()
        waiting = [
            node
            for node, cost in enumerate(self._cost)
            if node not in graph.moves and node not in graph.decided and cost < self._horizon
        ]
        return min(waiting, key=self._cost.__getitem__, default=None)

    def _undecided(self) -> set[int]:
        """Return the nodes that can be reached with a goal that is neither reached nor lost."""
        found: set[int] = set()
        for start in set(self.found.starts):
            watches = [watch for watch, its in zip(self._watches, self.found.starts, strict=True) if its == start]
            waiting: list[tuple[int, Memories]] = [(start, (0,) * len(watches))]
            known: set[tuple[int, Memories]] = set(waiting)
            while waiting:
                node, memories = waiting.pop()
                for move in self.found.graph.moves.get(node, {}).values():
                    after = (move.to, advance_all(watches, memories, move))
                    if after not in known and not is_decided(after[1]):
                        known.add(after)
                        waiting.append(after)
            found |= {node for node, _ in known}
        return found

    def expand(self, node: int) -> None:
        """Try every answer at a node."""
        self.found.graph.moves[node] = {answer: self._try(node, answer) for answer in self._laboratory.answers}

    def _try(self, node: int, answer: str) -> Move:
        self._laboratory.sim.restore(self._snapshots[node])
        held: list[frozenset[Atom]] = []
        steps = self._laboratory.do(answer, held.append, self._horizon - self._cost[node])
        if steps > SETTLE:
            self.found.moves += 1
            self.found.steps += steps
        trace = tuple((true, len(list(run))) for true, run in groupby(held))
        return Move(self._reach(self._cost[node] + steps), steps, trace)

    def _reach(self, cost: int) -> int:
        """Return the node of the present state, a new one where it is not known."""
        place = self._laboratory.place()
        node = next((k for k, known in enumerate(self._places) if known.same(place)), len(self._places))
        if node == len(self._places):
            self.found.graph.pictures.append(node)
            self.found.pictures.append(photograph(self._laboratory.sim))
            self.found.true.append(place.true)
            self._snapshots.append(self._laboratory.sim.snapshot())
            self._places.append(place)
            self._cost.append(cost)
        self._cost[node] = min(self._cost[node], cost)
        return node


def walk(
    laboratory: Laboratory,
    tasks: Sequence[Task],
    policy: Callable[[tuple[Picture, ...]], str | None],
    horizon: int = HORIZON,
) -> int:
    """Let a policy without memory act from pictures alone, from where a simulation is; return how many goals came true.

    Such a policy goes the same way whatever the goal, so it goes once and every goal is looked for on the way.

    Args:
        tasks: whose goals are looked for within the horizon.
        policy: pictures with the arm at home → answer; None where it has none.
    """
    waiting = [Progress(task) for task in tasks]
    steps = reached = 0

    def listen(_: frozenset[Atom]) -> None:
        nonlocal steps, reached
        steps += 1
        if steps <= horizon:
            reached += sum([progress.step(laboratory.sim.holds) for progress in waiting])
            waiting[:] = [progress for progress in waiting if not progress.success and not progress.lost]

    while waiting and steps < horizon:
        answer = policy(photograph(laboratory.sim))
        if answer is None:
            break
        laboratory.do(answer, listen, horizon - steps)
    return reached
