"""The expert: a plan made from the task's checkpoints and goal, carried out and checked."""

from __future__ import annotations

from collections.abc import Callable, Generator

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts import motions
from lerobot_memobench.experts.hand import OPEN, Hand
from lerobot_memobench.sim.scene import TABLE, TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import And, Atom, Formula, Not, Or, Then
from lerobot_memobench.tasks.task import Task

Doing = Generator[NDArray[np.float32], None, None]

TRIES = 3
"""How often a thing is picked up and placed before the plan goes on without it."""
REPAIRS = 3
"""How often the goal is gone through again when something in it does not hold at the end."""


def steps_of(formula: Formula) -> list[Atom]:
    """Return the atoms to bring about, in order. What must not be (`Not`) is nothing to do; of an `Or` the first."""
    match formula:
        case Atom():
            return [formula]
        case And(children) | Then(children):
            return [atom for child in children for atom in steps_of(child)]
        case Or(children):
            return steps_of(children[0]) if children else []
        case Not():
            return []
    raise TypeError(f"not a formula: {formula!r}")


class Expert:
    """Solve a task by its checkpoints, in order, then by whatever of the goal is still open.

    It looks into the simulator, as a demonstrator with perfect sight would, and says one action per control step.

    Args:
        task: goal and checkpoints.
        sim: the running scene.
        rng: source of small variation in speed, grasp and approach.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        self.task, self.sim = task, sim
        self._hand = Hand(sim, rng)
        self._was: set[tuple[str, ...]] = set()
        self._doing = self._plan()
        self.done = False

    def act(self) -> NDArray[np.float32]:
        """Return the action (7,) for the present state; holding still with open fingers once the plan is done.

        Ask once per control step: each call moves the plan on.
        """
        if not self.done:
            try:
                return np.clip(next(self._doing), -1.0, 1.0)
            except StopIteration:
                self.done = True
        return np.array([0, 0, 0, 0, 0, 0, OPEN], dtype=np.float32)

    def _plan(self) -> Doing:
        for checkpoint in self.task.checkpoints:
            for atom in steps_of(checkpoint.goal):
                yield from self.achieve(atom)
        for _ in range(REPAIRS):
            missing = [atom for atom in steps_of(self.task.goal) if not self._holds(atom)]
            if not missing:
                break
            for atom in missing:
                yield from self.achieve(atom)

    def _holds(self, atom: Atom) -> bool:
        if atom.predicate in ("wasopen", "wasturnedon"):
            return (atom.predicate, *atom.args) in self._was
        return self.sim.holds(atom)

    def achieve(self, atom: Atom) -> Doing:
        """Bring one atom about, unless it is already so."""
        if self._holds(atom):
            return
        hand = self._hand
        match atom.predicate, atom.args:
            case ("open" | "wasopen"), (name,):
                yield from self._open(name)
                self._was.add(("wasopen", name))
            case "close", (name,):
                yield from motions.close_drawer(hand, name)
            case ("turnon" | "wasturnedon"), (name,):
                yield from motions.turn_knob(hand, name, on=True)
                self._was.add(("wasturnedon", name))
            case "turnoff", (name,):
                yield from motions.turn_knob(hand, name, on=False)
            case "in", (name, region):
                yield from self._bring(atom, lambda: self._put_in(name, region))
            case "on", (name, support):
                yield from self._bring(atom, lambda: self._put_on(name, support))
            case _:
                raise MemobenchError(f"the expert has no motion for {atom}")

    def _bring(self, atom: Atom, once: Callable[[], Doing]) -> Doing:
        """Pick and place until it holds: a thing may slip on the way."""
        for _ in range(TRIES):
            yield from once()
            if self._holds(atom):
                return

    def _put_on(self, name: str, support: str) -> Doing:
        held = yield from motions.pick(self._hand, name)
        if held is None:
            return
        if support in self.sim.assets:
            yield from motions.put_on(self._hand, held, support)
        else:
            yield from motions.put_on_region(self._hand, held, self._middle_of(support))

    def _middle_of(self, region: str) -> NDArray[np.float64]:
        """The middle of a region's upper face, (3,), m."""
        declared = self.task.regions.get(region)
        if declared is not None and declared.target == TABLE:
            x1, y1, x2, y2 = declared.ranges[0]
            return np.array([(x1 + x2) / 2, (y1 + y2) / 2, TABLE_TOP])
        centre, rotation = self.sim.site_pose(region)
        return centre + rotation @ np.array([0.0, 0.0, self.sim.site_half_size(region)[2]])

    def _open(self, name: str) -> Doing:
        yield from motions.open_drawer(self._hand, name)

    def _put_in(self, name: str, region: str) -> Doing:
        articulation, q = self.sim.world.articulation(region)
        if articulation.open_below is not None and q > articulation.open_below:
            yield from self._open(region)
        out = motions.outward_of(self._hand, articulation)
        held = yield from motions.pick(self._hand, name, avoid=out)
        if held is not None:
            yield from motions.put_in_drawer(self._hand, held, region, out)
