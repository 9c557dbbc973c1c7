"""Solve tasks, and play demonstration prompts: derive a plan from checkpoints and goal, execute and verify it.

For goals that count or order events, `plan_of` derives the plan from the goal: events, repetitions, returns home.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.experts import fixtures
from lerobot_memobench.experts.grasping import pick, put_at, put_in_drawer, put_on, put_on_region
from lerobot_memobench.experts.hand import CLOSED, OPEN, UP, Hand, Steps
from lerobot_memobench.experts.travel import (
    HAND_HOME,
    come_home,
    drawer_containing,
    go_home,
    opening_direction,
    pointing,
    protrudes_from_drawer,
    region_box,
)
from lerobot_memobench.sim.asset import TABLE, TABLE_TOP
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
    walk,
)
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator
from lerobot_memobench.tasks.task import STRICT, Task
from mujoco_raster.highlights import Highlight

MAX_TRIES = 3  # attempts at placing an object or executing a step before the plan continues without it
HOME_REST_STEPS = 10
"""Control steps at home between two events. Policies trained on a hand that turns around at home within one step learn
to turn around before they reach it."""
MAX_REPAIRS = 3  # passes over the goal's atoms that do not hold at the end
PAUSE_STEPS = 8  # steps at rest before and after a prompt, so that it has a first and a last frame
HIGHLIGHT_STEPS = 50
HIDING_SPEED_FACTOR = 1.25  # speed factor while hiding objects, so that two hidings fit into a prompt
Step = Atom | Hold  # an atom to achieve, or a rest: a `Hold` whose child is already true

_PASSIVE_PREDICATES = ("inplace", "ajar", "lifted")  # predicates without a motion
_HOME_PREDICATES = ("handhome", "asbegun")  # predicates achieved by returning home


def steps_of(formula: Formula) -> list[Atom]:
    """Return the atoms to achieve, in order; skip negations and take the first alternative of an `Or`.

    Repetitions are not represented, see `plan_of`.
    """
    match formula:
        case Atom():
            return [formula]
        case Not() | Never():
            return []
        case Or(parts):
            return steps_of(parts[0])
        case When((condition, outcome)):
            return [*steps_of(outcome), *steps_of(condition)]
    return [atom for part in children(formula) for atom in steps_of(part)]


def final_atoms(formula: Formula) -> list[Atom]:
    """Return the atoms that a goal requires at its end: those of a `When` may have become false again."""
    parts = formula.children if isinstance(formula, And) else (formula,)
    return [atom for part in parts if not isinstance(part, When) for atom in steps_of(part)]


def hold_steps_of(formula: Formula) -> int:
    """Return the maximum number of steps for which a goal's atoms must hold, summed over nested operators."""
    own = formula.number if isinstance(formula, Hold) else HOLD_STEPS if isinstance(formula, Then) else 0
    return own + max((hold_steps_of(child) for child in children(formula)), default=0)


def counts_events(formula: Formula) -> bool:
    """Return whether a formula counts events."""
    return any(isinstance(part, Exactly) for part in walk(formula))


def plan_of(formula: Formula) -> list[Step]:
    """Return the steps that make a formula true, in order."""
    match formula:
        case Atom():
            return [] if formula.predicate in _PASSIVE_PREDICATES else [formula]
        case Not() | Never():
            return []
        case And(parts):
            # Shared steps are planned once: one part may count all rounds, and another those that begin at home.
            return _merge_plans([plan_of(part) for part in sorted(parts, key=_rank)])
        case Or(parts):
            return plan_of(parts[0])
        case Then(parts) | Round(parts):
            return list(chain.from_iterable(plan_of(part) for part in parts))
        case Exactly(number, child):
            return plan_of(child) * number
        case Hold(child=child):
            return [*plan_of(child), formula]
        case When((condition, outcome)):
            return [*plan_of(outcome), *plan_of(condition)]
    raise TypeError(f"not a formula: {formula!r}")


def _rank(formula: Formula) -> int:
    """Return the planning order of a part: preconditions (`When`), then placements, then the rest (closing)."""
    is_placement = isinstance(formula, Atom) and formula.predicate in ("in", "on")
    return 0 if isinstance(formula, When) else 1 if is_placement else 2


def _merge_plans(plans: list[list[Step]]) -> list[Step]:
    merged: list[Step] = []
    for plan in plans:
        remaining = iter(merged)
        if not all(step in remaining for step in plan):
            common = next(n for n in range(len(plan), -1, -1) if n == 0 or merged[-n:] == plan[:n])
            merged += plan[common:]
    return merged


class Expert:
    """Solve a task: achieve its checkpoints in order, then the goal's remaining atoms.

    A goal that counts events defines the plan itself, because the present state does not show past events. The expert
    reads the state of a running simulation and returns one action per control step; speed, grasps and approaches vary.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        self.task, self.sim = task, sim
        self.hand = Hand(sim, rng)
        self._evaluator = Evaluator([task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)])
        self._started = False
        self._motion = self._plan()
        self.done = False
        """Whether the goal holds or the plan has ended. `act` may still be called and continues the present motion,
        because policies trained on it cannot observe the step in which the goal becomes true."""
        self.succeeded = False  # whether the goal held at the last call of `act`

    def act(self) -> NDArray[np.float32]:
        """Return the action (7,) for the present state, and advance the plan; after it come to rest, fingers open."""
        if self._started:
            # Track latches and order: present atoms alone do not determine the goal.
            self.succeeded, *_ = self._evaluator.step(self.sim.holds)
            self.done = self.done or self.succeeded
        self._started = True
        try:
            return np.clip(next(self._motion), -1.0, 1.0)
        except StopIteration:
            self.done = True
        return self.hand.rest()

    def _plan(self) -> Steps:
        if counts_events(self.task.goal):
            for step in plan_of(self.task.goal):
                yield from self._run_step(step)
            return
        for checkpoint in self.task.checkpoints:
            for atom in steps_of(checkpoint.goal):
                yield from self.achieve(atom)
        for _ in range(MAX_REPAIRS):
            missing = [atom for atom in final_atoms(self.task.goal) if not self._holds(atom)]
            if not missing:
                break
            for atom in missing:
                yield from self.achieve(atom)
        for _ in range(hold_steps_of(self.task.goal)):
            yield self.hand.rest()

    def _run_step(self, step: Step) -> Steps:
        if isinstance(step, Hold):
            rest = step.number
        else:
            rest = HOME_REST_STEPS if step.predicate in _HOME_PREDICATES and not self._holds(step) else 0
            for _ in range(MAX_TRIES):  # a skipped step would make the count wrong
                yield from self.achieve(step)
                if self._holds(step):
                    break
        for _ in range(rest):
            yield self.hand.toward(*self.sim.home, OPEN)

    def _holds(self, atom: Atom) -> bool:
        if atom.predicate in LATCHES:
            return atom in self._evaluator.latched
        return self.sim.holds(atom)

    def achieve(self, atom: Atom) -> Steps:
        """Achieve one atom unless it already holds."""
        if self._holds(atom):
            return
        match atom.predicate, atom.args:
            case (("handhome" | "asbegun"), ()):
                yield from come_home(self.hand, *self.sim.home)
            case (("open" | "wasopen"), (name,)):
                yield from self._set_open(name, True)
            case "close", (name,):
                yield from self._set_open(name, False)
            case (("turnon" | "wasturnedon"), (name,)):
                yield from fixtures.turn_knob(self.hand, name, on=True)
            case "turnoff", (name,):
                yield from fixtures.turn_knob(self.hand, name, on=False)
            case "in", (name, region):
                yield from self._place_until_holds(atom, lambda: self._put_in(name, region))
            case "on", (name, support):
                yield from self._place_until_holds(atom, lambda: self._put_on(name, support))
            case _:
                raise MemobenchError(f"the expert has no motion for {atom}")

    def _place_until_holds(self, atom: Atom, once: Callable[[], Steps]) -> Steps:
        for _ in range(MAX_TRIES):  # an object may slip, or lean on a drawer's wall
            yield from once()
            if self._holds(atom) and not (atom.predicate == "in" and protrudes_from_drawer(self.hand, *atom.args)):
                return

    def _put_on(self, name: str, support: str) -> Steps:
        on_object = support in self.sim.assets
        middle = self.sim.asset_pose(support)[0] if on_object else self._region_top(support)
        drawer = drawer_containing(self.hand, name)
        if drawer is not None:
            yield from self.achieve(Atom("open", (drawer,)))
        held = yield from pick(self.hand, name, place=middle - self.sim.assets[name].bottom * UP)
        if held is not None and on_object:
            yield from put_on(self.hand, held, support)
        elif held is not None:
            yield from put_on_region(self.hand, held, self._region_top(support))

    def _region_top(self, region: str) -> NDArray[np.float64]:
        declared = self.task.regions.get(region)
        if declared is not None and declared.target == TABLE:
            x1, y1, x2, y2 = declared.ranges[0]
            return np.array([(x1 + x2) / 2, (y1 + y2) / 2, TABLE_TOP])
        centre, rotation, half = region_box(self.hand, region)
        return centre + rotation @ np.array([0.0, 0.0, half[2]])

    def _set_open(self, name: str, opening: bool) -> Steps:
        if self.sim.world.articulation(name)[0].kind != "door":
            return (fixtures.open_drawer if opening else fixtures.close_drawer)(self.hand, name)
        if self.task.suite == STRICT:  # not `Hand.strict`: the blind routine solves a published task in a strict scene
            return fixtures.sweep_door(self.hand, name, opening)
        return (fixtures.open_door if opening else fixtures.close_door)(self.hand, name)

    def _put_in(self, name: str, region: str) -> Steps:
        drawers = [name for name, (articulation, _) in self.sim.world.joints.items() if articulation.kind == "drawer"]
        if region not in drawers:
            hint = nearest(region, drawers) if drawers else "the scene has no drawer; use another policy"
            raise MemobenchError(f"the expert places objects into drawers only, and {region!r} is not a drawer; {hint}")
        articulation, q = self.sim.world.articulation(region)
        if q > articulation.open_below:
            yield from self._set_open(region, True)
        out = opening_direction(self.hand, articulation)
        held = yield from pick(self.hand, name, avoid=out)
        if held is not None:
            yield from put_in_drawer(self.hand, held, region, out)


def blind_routine(task: Task, sim: Simulation, rng: np.random.Generator) -> Steps:
    """Reach a published task's goal, return to the first pose and repeat, forever: a baseline without memory.

    It ignores prompt and instruction. ``task``: for a strict task the one it is derived from.
    """
    home = sim.eef_pose()
    while True:  # no state is kept between rounds, so the routine cannot count
        expert = Expert(task, sim, rng)
        while not expert.done:
            yield expert.act()
        yield from come_home(expert.hand, *home)


# --- demonstration prompts; the episode restores the scene after one, except for hidden objects ---


class PromptDemonstrator:
    """Play the demonstration prompt of a task, a variant if the referent is random.

    The simulation runs and is in the episode's initial state.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        assert task.prompt is not None
        self._task, self._sim, self._rng = task, sim, rng
        self._prompt = task.prompt
        self._referent = task.prompt.target or ""
        self.succeeded = False  # whether the last prompt succeeded, for example whether a routine reached its goal

    def actions(self) -> Iterator[NDArray[np.float32]]:
        """Yield the actions (7,) of the prompt, one per control step."""
        hand = Hand(self._sim, self._rng)
        home = self._sim.eef_pose()
        yield from hand.wait(PAUSE_STEPS, OPEN)
        match self._prompt.kind:
            case "routine":
                expert = Expert(self._task, self._sim, self._rng)
                while not expert.done:
                    yield expert.act()
                self.succeeded = expert.succeeded
                yield from go_home(expert.hand, *home)
            case "pick":
                yield from self._pick(hand)
            case "point":
                yield from self._point(hand)
            case "highlight":
                self._sim.highlights = highlights_at(self._task, self._sim, PAUSE_STEPS)
                self.succeeded = True
                yield from hand.wait(HIGHLIGHT_STEPS, OPEN)
                self._sim.highlights = ()
            case "hide":
                yield from self._hide()
                return
        yield from go_home(hand, *home)
        yield from hand.wait(PAUSE_STEPS, OPEN)

    def _hide(self) -> Steps:
        """Put each object into its drawer, close the drawer, and return home; shown if all objects are hidden."""
        expert = Expert(self._task, self._sim, self._rng)
        expert.hand.speed = min(1.0, HIDING_SPEED_FACTOR * expert.hand.speed)
        hidden = [
            atom
            for thing, drawer in self._prompt.places
            for atom in (Atom("in", (thing, drawer)), Atom("close", (drawer,)))
        ]
        for atom in (*hidden, HAND_HOME):
            yield from expert.achieve(atom)
        yield from expert.hand.wait(PAUSE_STEPS, OPEN)
        self.succeeded = all(self._sim.holds(atom) for atom in (*hidden, HAND_HOME))

    def _pick(self, hand: Hand) -> Steps:
        position, rotation = self._sim.asset_pose(self._referent)
        held = yield from pick(hand, self._referent)
        if held is not None:
            self.succeeded = True
            yield from hand.wait(PAUSE_STEPS, CLOSED)
            yield from put_at(hand, held, position, rotation)

    def _point(self, hand: Hand) -> Steps:
        position, _ = self._sim.asset_pose(self._referent)
        above = position + (self._sim.assets[self._referent].top + 0.03) * UP
        rotation = pointing(hand, above)
        yield from hand.move(above + 0.10 * UP, rotation, CLOSED, tolerance=0.015)
        for height in (0.0, 0.05, 0.0):
            yield from hand.move(above + height * UP, rotation, CLOSED, tolerance=0.008, speed=0.6, timeout=60)
        yield from hand.wait(PAUSE_STEPS, CLOSED)
        self.succeeded = bool(np.linalg.norm((hand.position - position)[:2]) < 0.03)
        yield from hand.move(above + 0.10 * UP, rotation, CLOSED, tolerance=0.02)


def highlights_at(task: Task, sim: Simulation, frame: int) -> tuple[Highlight, ...]:
    """Return the highlights at a frame of a task's demonstration prompt, at the present poses in ``sim``."""
    prompt = task.prompt
    if prompt is None or prompt.kind != "highlight" or prompt.target is None:
        return ()
    if not PAUSE_STEPS <= frame < PAUSE_STEPS + HIGHLIGHT_STEPS:
        return ()
    return (highlight_of(sim, prompt.target),)


def highlight_of(sim: Simulation, name: str) -> Highlight:
    """Return a highlight below an object."""
    asset, (position, _) = sim.assets[name], sim.asset_pose(name)
    spot = (float(position[0]), float(position[1]), float(position[2] + asset.bottom + 0.002))
    return Highlight(spot, asset.radius + 0.035)
