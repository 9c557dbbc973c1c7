"""What the expert decides, and what is seen when it does.

Every decision is photographed twice: as it happens, and with the arm put back to where the execution began. The
simulator and the expert are imported when they are needed.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.necessity.home import Home
from lerobot_memobench.evaluation.necessity.pictures import Picture, photograph
from lerobot_memobench.evaluation.necessity.starts import begin
from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.formula import LATCHES, SINCE_START, Atom, Formula, Hold, children
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.experts.expert import Doing, Expert
    from lerobot_memobench.sim.simulation import Simulation


@dataclass(frozen=True)
class Moment:
    """A decision of the expert.

    Attributes:
        answer: what it begins to do.
        step: control steps of the execution so far.
        seen: pictures as it happens. at_home: pictures with the arm at home.
        proprio: (8,) as it happens; at home it is the same at every decision of an episode.
    """

    answer: str
    step: int
    seen: tuple[Picture, ...]
    at_home: tuple[Picture, ...]
    proprio: NDArray[np.float32]


@dataclass(frozen=True)
class Demonstration:
    """An episode of the expert: its decisions, whether the goal came true in time, and after how many steps."""

    moments: tuple[Moment, ...]
    success: bool
    steps: int


REST = "rest"
"""The answer to do nothing more."""
HOME = Atom("handhome", ())
STILL = 0.001
"""Change of proprioception (m, rad) in a step up to which the hand stands still."""


def rest_steps(formula: Formula) -> int:
    """Return for how many steps a goal asks to hold still, 0 where it does not."""
    inside = max((rest_steps(child) for child in children(formula)), default=0)
    return max(inside, formula.number) if isinstance(formula, Hold) else inside


def answer_of(atom: Atom) -> Atom:
    """Return what has to be done for an atom: of a latch, what it remembers."""
    return Atom(LATCHES.get(atom.predicate, atom.predicate), atom.args)


def expert_of(task: Task, sim: Simulation, seed: int, listen: Callable[[Atom], object] | None = None) -> Expert:
    """Return the expert as an episode of this seed has it.

    Args:
        listen: told what the expert begins to do whenever it turns to something.
    """
    from lerobot_memobench.experts.expert import Expert

    class Noting(Expert):
        """Tells what it turns to."""

        def achieve(self, atom: Atom) -> Doing:
            """Bring one atom about, and say so unless it is so already or no more than a way to stand."""
            if listen is not None and atom.predicate not in SINCE_START and not self._holds(atom):
                listen(answer_of(atom))
            yield from super().achieve(atom)

    return Noting(task, sim, np.random.default_rng([seed, zlib.crc32(task.name.encode()), 3]))


def follow(task: Task, sim: Simulation, seed: int, horizon: int = HORIZON) -> Demonstration:
    """Let the expert do a task (or a variant of it) from a seed's start, and look at each of its decisions."""
    begin(task, sim, seed)
    watcher, progress = _Watcher(task, sim), Progress(task)
    turns: list[Atom] = []
    expert = expert_of(task, sim, seed, turns.append)
    while not progress.success and not progress.lost and progress.steps < horizon and not expert.done:
        action = expert.act()
        if turns and not expert.done:
            watcher.note(turns[-1], progress.steps)  # what it turns to on the way to another thing is done first
            turns.clear()
        sim.step(action)
        progress.step(sim.holds)
        watcher.look_for_rest(progress.steps)
    return Demonstration(watcher.moments(progress.success), progress.success, progress.steps)


class _Watcher:
    """Photographs decisions, and where a goal asks for rest, the hand come home at last as the decision to rest."""

    def __init__(self, task: Task, sim: Simulation) -> None:
        self._sim, self._home = sim, Home(sim)
        self._rests = rest_steps(task.goal) > 0
        self._was_home, self._before = True, sim.proprio()
        self._noted: list[tuple[Atom, Moment]] = []
        self._rest: Moment | None = None

    def note(self, answer: Atom, step: int) -> None:
        """Take down what the expert turns to now."""
        self._noted.append((answer, self._photograph(str(answer), step)))
        self._rest = None

    def look_for_rest(self, step: int) -> None:
        """Photograph the hand that has come home and stands: if nothing follows, this is where it decided to rest."""
        if not self._rests:
            return
        now = self._sim.proprio()
        still = bool(np.abs(now - self._before).max() <= STILL)
        if self._sim.holds(HOME) and still and not self._was_home:
            self._rest = self._photograph(REST, step)
        self._was_home = self._sim.holds(HOME) and (still or self._was_home)
        self._before = now

    def moments(self, success: bool) -> tuple[Moment, ...]:
        """Return the decisions of an episode that has ended."""
        # While a `Then` still counts how long its last part holds, the expert may turn to what is not asked for.
        while success and self._noted and not self._sim.holds(self._noted[-1][0]):
            self._noted.pop()
        rest = () if self._rest is None else (self._rest,)
        return (*(moment for _, moment in self._noted), *rest)

    def _photograph(self, answer: str, step: int) -> Moment:
        return Moment(answer, step, photograph(self._sim), self._home.look(), self._sim.proprio())
