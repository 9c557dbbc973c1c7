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
from lerobot_memobench.tasks.formula import LATCHES, Atom
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.experts.expert import Doing, Expert
    from lerobot_memobench.sim.simulation import Simulation

HORIZON = 1200


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
            """Bring one atom about, and say so unless it is so already."""
            if listen is not None and not self._holds(atom):
                listen(answer_of(atom))
            yield from super().achieve(atom)

    return Noting(task, sim, np.random.default_rng([seed, zlib.crc32(task.name.encode()), 3]))


def follow(task: Task, sim: Simulation, seed: int, horizon: int = HORIZON) -> Demonstration:
    """Let the expert do a task (or a variant of it) from a seed's start, and look at each of its decisions."""
    sim.reset(seed)
    home, progress = Home(sim), Progress(task)
    progress.reset()
    turns: list[Atom] = []
    expert = expert_of(task, sim, seed, turns.append)
    moments: list[Moment] = []
    answers: list[Atom] = []
    while not progress.success and progress.steps < horizon and not expert.done:
        action = expert.act()
        if turns and not expert.done:
            answers.append(turns[-1])  # what it turns to on the way to another thing is what it does first
            turns.clear()
            seen, proprio = photograph(sim), sim.proprio()
            moments.append(Moment(str(answers[-1]), progress.steps, seen, home.look(), proprio))
        sim.step(action)
        progress.step(sim.holds)
    # While a `Then` still counts how long its last part holds, the expert may turn to something that is not asked for.
    while progress.success and moments and not sim.holds(answers[-1]):
        moments.pop()
        answers.pop()
    return Demonstration(tuple(moments), progress.success, progress.steps)
