"""One scene in which answers are tried out: from any state, with the arm at home before and after."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.necessity.demonstrations import REST, answer_of, expert_of, rest_steps
from lerobot_memobench.evaluation.necessity.home import Home
from lerobot_memobench.evaluation.necessity.starts import begin
from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.formula import SINCE_START, Atom, Formula, atoms
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation, Snapshot

SAME_PLACE = 0.02
"""Distance up to which an object is where it was when states of the exploration are told apart, m."""
SAME_JOINT = {"slide": 0.02, "hinge": 0.2}
"""The same for drawers (m) and for doors and knobs (rad)."""


def answers_of(variants: Sequence[Task]) -> list[Atom]:
    """Return everything the expert brings about in some variant: the decision set."""
    from lerobot_memobench.experts.expert import steps_of

    found: dict[Atom, None] = {}
    for task in variants:
        for formula in (*(checkpoint.goal for checkpoint in task.checkpoints), task.goal):
            found.update((answer_of(atom), None) for atom in steps_of(formula) if atom.predicate not in SINCE_START)
    return list(found)


@dataclass(frozen=True)
class Place:
    """Where things are, for telling states apart."""

    true: frozenset[Atom]
    objects: NDArray[np.float64]
    joints: NDArray[np.float64]
    reach: NDArray[np.float64]

    def same(self, other: Place) -> bool:
        """Whether nothing of note lies or stands elsewhere."""
        return (
            self.true == other.true
            and bool(np.all(np.linalg.norm(self.objects - other.objects, axis=-1) < SAME_PLACE))
            and bool(np.all(np.abs(self.joints - other.joints) < self.reach))
        )


class Laboratory:
    """One scene in which answers are tried out, from states with the arm at home.

    Args:
        variants: the task and its variants, which share the scene.
        sim: its simulation.
        seed: of the start.

    Attributes:
        answers: what can be done: `REST` where a goal asks for rest, and what the expert does.
        starts: where each variant's execution begins; the same for all but those whose prompt changes the scene.
    """

    def __init__(self, variants: Sequence[Task], sim: Simulation, seed: int) -> None:
        self.variants, self.sim, self.seed = variants, sim, seed
        goals: list[Formula] = [task.goal for task in variants]
        self._deeds = {str(atom): atom for atom in answers_of(variants)}
        self._rest = max(rest_steps(goal) for goal in goals)
        self.answers = (*self._deeds, REST) if self._rest else tuple(self._deeds)
        self._atoms = sorted({answer_of(atom) for goal in goals for atom in atoms(goal)}, key=str)
        self.starts: list[Snapshot] = []
        for variant in variants:
            begin(variant, sim, seed)
            self.starts.append(sim.snapshot())
        self.home = Home(sim)

    def true(self) -> frozenset[Atom]:
        """Return the atoms of the goals that hold now."""
        return frozenset(atom for atom in self._atoms if self.sim.holds(atom))

    def do(self, answer: str, listen: Callable[[frozenset[Atom]], None], limit: int = HORIZON) -> int:
        """Let the expert carry out an answer, come home, and settle; return the steps it took.

        Args:
            listen: told the atoms that hold after each step.
            limit: steps after which the answer is broken off.
        """
        steps = 0
        for action in self._motion(answer):
            if steps >= limit:
                break
            self.sim.step(np.clip(action, -1.0, 1.0))
            steps += 1
            listen(self.true())
        for _ in self.home.settle():
            steps += 1
            listen(self.true())
        return steps

    def _motion(self, answer: str) -> Iterator[NDArray[np.floating]]:
        """Yield the actions of an answer; none where it is so already, or nobody can see what to take."""
        from lerobot_memobench.sim.simulation import NO_OP

        if answer == REST:
            yield from (NO_OP for _ in range(self._rest))
            return
        atom = self._deeds[answer]
        if not self.sim.holds(atom) and not self._shut_away(atom.args[0]):
            yield from expert_of(self.variants[0], self.sim, self.seed).achieve(atom)

    def _shut_away(self, thing: str) -> bool:
        """Whether a thing lies in a closed drawer: an expert that looks into the simulator would know which."""
        if thing not in self.sim.task.objects:
            return False
        drawers = [f"{name}_{part}" for name, asset in self.sim.assets.items() for part in asset.articulations if part]
        return any(self.sim.holds(Atom("in", (thing, it))) and self.sim.holds(Atom("close", (it,))) for it in drawers)

    def place(self) -> Place:
        """Return where things are now."""
        sim = self.sim
        objects = [sim.body_pose(name)[0] for name, asset in sim.assets.items() if asset.kind != "fixture"]
        articulations = [
            sim.world.articulation(f"{name}_{region}" if region else name)
            for name, asset in sim.assets.items()
            for region in asset.articulations
        ]
        return Place(
            self.true(),
            np.array(objects).reshape(-1, 3),
            np.array([q for _, q in articulations]),
            np.array([SAME_JOINT["slide" if a.kind == "drawer" else "hinge"] for a, _ in articulations]),
        )
