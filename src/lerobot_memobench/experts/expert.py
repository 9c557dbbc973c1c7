"""The expert: a plan made from the task's checkpoints and goal, carried out and checked.

A goal that counts events or asks for their order is its own plan (`plan_of`): what to do, how often, when to come home.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.experts.fixtures import (
    close_door,
    close_drawer,
    open_door,
    open_drawer,
    pull_open,
    push_shut,
    turn_knob,
)
from lerobot_memobench.experts.grasping import pick, put_in_drawer, put_on, put_on_region
from lerobot_memobench.experts.hand import OPEN, UP, Hand, Steps
from lerobot_memobench.experts.travel import come_home, drawer_around, outward_of, region_box, stands_out
from lerobot_memobench.sim.assets.kitchen import TABLE, TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import (
    LATCHES,
    And,
    Atom,
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
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator
from lerobot_memobench.tasks.task import STRICT, Task

TRIES = 3
"""How often a thing is picked up and placed, or a step taken, before the plan goes on without it."""
LINGER = 10
"""Control steps for which it stays at home between two events: who learns from a hand that turns there in a single step
learns to turn short of it."""
REPAIRS = 3
"""How often the goal is gone through again when something in it does not hold at the end."""
Step = Atom | Hold
"""An atom to bring about, or a rest: a `Hold` whose child is so already."""

_NOT_BROUGHT_ABOUT = ("inplace", "ajar", "lifted")
"""Predicates that an expert leaves alone."""
_HOME = ("handhome", "asbegun")
"""Predicates that an expert brings about by coming home."""


def steps_of(formula: Formula) -> list[Atom]:
    """Return the atoms to bring about, in order. What must not be (`Not`) is nothing to do; of an `Or` the first.

    How often something is to be done is not in here: see `plan_of`.
    """
    match formula:
        case Atom():
            return [formula]
        case Not() | Never():
            return []
        case Or(parts):
            return steps_of(parts[0])
        case When((moment, then)):
            return [*steps_of(then), *steps_of(moment)]
    return [atom for part in children(formula) for atom in steps_of(part)]


def rest_of(formula: Formula) -> int:
    """Return for how many steps at most a goal's atoms have to hold until it does: each operator waits for its own."""
    own = formula.number if isinstance(formula, Hold) else HOLD_STEPS if isinstance(formula, Then) else 0
    return own + max((rest_of(child) for child in children(formula)), default=0)


def counts(formula: Formula) -> bool:
    """Return whether a formula asks how often something has come about."""
    return isinstance(formula, Exactly) or any(counts(child) for child in children(formula))


def plan_of(formula: Formula) -> list[Step]:
    """Return the steps that make a formula true, in order.

    What the parts of an ``And`` have in common is done once: counting the rounds that began at home, and counting
    all rounds, is one counting.
    """
    match formula:
        case Atom():
            return [] if formula.predicate in _NOT_BROUGHT_ABOUT else [formula]
        case Not() | Never():
            return []
        case And(parts):
            return _together([plan_of(part) for part in sorted(parts, key=_rank)])
        case Or(parts):
            return plan_of(parts[0])
        case Then(parts) | Round(parts):
            return list(chain.from_iterable(plan_of(part) for part in parts))
        case Exactly(number, child):
            return plan_of(child) * number
        case Hold(child=child):
            return [*plan_of(child), formula]
        case When((moment, then)):
            return [*plan_of(then), *plan_of(moment)]
    raise TypeError(f"not a formula: {formula!r}")


def _rank(formula: Formula) -> int:
    """What has to be so before another thing is begun goes first; where things belong goes before what is shut."""
    places = isinstance(formula, Atom) and formula.predicate in ("in", "on")
    return 0 if isinstance(formula, When) else 1 if places else 2


def _together(plans: list[list[Step]]) -> list[Step]:
    """Return one plan that holds all of them, each step that two have in common once."""
    whole: list[Step] = []
    for plan in plans:
        if not _within(plan, whole):
            common = next(n for n in range(len(plan), -1, -1) if n == 0 or whole[-n:] == plan[:n])
            whole += plan[common:]
    return whole


def _within(plan: list[Step], whole: list[Step]) -> bool:
    """Return whether all steps of a plan occur in another, in order."""
    left = iter(whole)
    return all(step in left for step in plan)


class Expert:
    """Solve a task by its checkpoints, in order, then by whatever of the goal is still open.

    A goal that counts events is its own plan: what is true of the present does not tell what has been done.

    It looks into the simulator, as a demonstrator with perfect sight would, and says one action per control step.

    Args:
        task: goal and checkpoints.
        sim: the running scene.
        rng: source of small variation in speed, grasp and approach.

    Attributes:
        done: nothing is left to do: the goal holds, or the plan has come to its end. Asked on, it goes on with what it
            was at: who learns from it cannot see the moment at which the goal comes to hold.
        succeeded: the goal held when the expert was last asked.
        hand: the arm it moves.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        self.task, self.sim = task, sim
        self.hand = Hand(sim, rng)
        self._watch = Evaluator([task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)])
        self._started = False
        self._doing = self._plan()
        self.done = self.succeeded = False

    def act(self) -> NDArray[np.float32]:
        """Return the action (7,) for the present state; coming to rest with open fingers once the plan is done.

        Ask once per control step: each call moves the plan on.
        """
        if self._started:
            # Latches and order are followed here too: what an atom says now does not tell whether a goal is reached.
            self.succeeded, *_ = self._watch.step(self.sim.holds)
            self.done = self.done or self.succeeded
        self._started = True
        try:
            return np.clip(next(self._doing), -1.0, 1.0)
        except StopIteration:
            self.done = True
        return self.hand.rest(OPEN)

    def _plan(self) -> Steps:
        if counts(self.task.goal):
            for step in plan_of(self.task.goal):
                yield from self._take(step)
            return
        for checkpoint in self.task.checkpoints:
            for atom in steps_of(checkpoint.goal):
                yield from self.achieve(atom)
        for _ in range(REPAIRS):
            missing = [atom for atom in steps_of(self.task.goal) if not self._holds(atom)]
            if not missing:
                break
            for atom in missing:
                yield from self.achieve(atom)
        for _ in range(rest_of(self.task.goal)):
            yield self.hand.rest(OPEN)

    def _take(self, step: Step) -> Steps:
        """Bring an atom about, or rest at home."""
        rest = step.number if isinstance(step, Hold) else LINGER * (step.predicate in _HOME and not self._holds(step))
        if isinstance(step, Atom):
            for _ in range(TRIES):  # the count would be short of what is gone on without
                yield from self.achieve(step)
                if self._holds(step):
                    break
        for _ in range(rest):
            yield self.hand.toward(*self.sim.home, OPEN)

    def _holds(self, atom: Atom) -> bool:
        if atom.predicate in LATCHES:
            return atom in self._watch.latched
        return self.sim.holds(atom)

    def achieve(self, atom: Atom) -> Steps:
        """Bring one atom about, unless it is already so."""
        if self._holds(atom):
            return
        match atom.predicate, atom.args:
            case (("handhome" | "asbegun"), ()):
                yield from come_home(self.hand, *self.sim.home)
            case (("open" | "wasopen"), (name,)):
                yield from self._open(name)
            case "close", (name,):
                yield from self._close(name)
            case (("turnon" | "wasturnedon"), (name,)):
                yield from turn_knob(self.hand, name, on=True)
            case "turnoff", (name,):
                yield from turn_knob(self.hand, name, on=False)
            case "in", (name, region):
                yield from self._bring(atom, lambda: self._put_in(name, region))
            case "on", (name, support):
                yield from self._bring(atom, lambda: self._put_on(name, support))
            case _:
                raise MemobenchError(f"the expert has no motion for {atom}")

    def _bring(self, atom: Atom, once: Callable[[], Steps]) -> Steps:
        """Pick and place until it holds: a thing may slip on the way, or come to lean on a drawer's wall."""
        for _ in range(TRIES):
            yield from once()
            if self._holds(atom) and not (atom.predicate == "in" and stands_out(self.hand, *atom.args)):
                return

    def _put_on(self, name: str, support: str) -> Steps:
        on_object = support in self.sim.assets
        middle = self.sim.asset_pose(support)[0] if on_object else self._middle_of(support)
        place = middle - self.sim.assets[name].bottom * UP
        drawer = drawer_around(self.hand, name)
        if drawer is not None:
            yield from self.achieve(Atom("open", (drawer,)))
        held = yield from pick(self.hand, name, place=place)
        if held is not None and on_object:
            yield from put_on(self.hand, held, support)
        elif held is not None:
            yield from put_on_region(self.hand, held, self._middle_of(support))

    def _middle_of(self, region: str) -> NDArray[np.float64]:
        """The middle of a region's upper face, (3,), m."""
        declared = self.task.regions.get(region)
        if declared is not None and declared.target == TABLE:
            x1, y1, x2, y2 = declared.ranges[0]
            return np.array([(x1 + x2) / 2, (y1 + y2) / 2, TABLE_TOP])
        centre, rotation, half = region_box(self.hand, region)
        return centre + rotation @ np.array([0.0, 0.0, half[2]])

    def _open(self, name: str) -> Steps:
        door = pull_open if self.task.suite == STRICT else open_door
        return (door if self._is_door(name) else open_drawer)(self.hand, name)

    def _close(self, name: str) -> Steps:
        door = push_shut if self.task.suite == STRICT else close_door
        return (door if self._is_door(name) else close_drawer)(self.hand, name)

    def _is_door(self, name: str) -> bool:
        return self.sim.world.articulation(name)[0].kind == "door"

    def _put_in(self, name: str, region: str) -> Steps:
        drawers = [
            full
            for asset in self.sim.assets.values()
            for part, full in asset.regions.items()
            if part in asset.articulations
        ]
        if region not in drawers:
            known = nearest(region, drawers) if drawers else "the scene has no drawer, let a policy of your own do it"
            raise MemobenchError(f"the expert puts things into drawers only, and {region!r} is none; {known}")
        articulation, q = self.sim.world.articulation(region)
        if q > articulation.open_below:
            yield from self._open(region)
        out = outward_of(self.hand, articulation)
        held = yield from pick(self.hand, name, avoid=out)
        if held is not None:
            yield from put_in_drawer(self.hand, held, region, out)
