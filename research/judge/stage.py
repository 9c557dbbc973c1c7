"""Set states of a task's scene move by move, without physics, and judge sequences of states.

A recording holds states with the number of control steps that each lasts. `judge` evaluates checkpoints, goal and
choice as `envs.episode` does, once per control step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim import robot
from lerobot_memobench.sim.asset import TABLE, TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.assessment import Choice, handled_atoms
from lerobot_memobench.tasks.formula import LATCHES, Atom, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import STRICT, Task

SEED = 7
DWELL = 3
"""Control steps that a state lasts; more in procedural tasks (`cases`)."""
AWAY = 0.2
"""Rotation of the arm's first joint that takes the hand away from home, rad."""
CLEAR, COARSE, FINE = 0.15, 0.006, 0.0005
"""Height above a target from which an object is lowered, and the steps of lowering, m."""
ARM = robot.OTHERS.start
"""Positions of arm and fingers, the first of a state."""

Array = NDArray[np.float64]
Recording = list[tuple[Array, int]]


@dataclass(frozen=True)
class Move:
    """One change of the scene.

    Attributes:
        kind: turn a joint, put an object, bring the hand home or away, or rest.
        name: joint or object.
        place: target of an object; None for its start.
        share: position of a joint as a share of the way from its start to its bound of open or on, so that more than
            1 is open; for the hand at home the rotation of the arm's first joint, rad.
        offset: displacement of an object from the target's centre or its start, m.
        steps: control steps that the new state lasts.
    """

    kind: Literal["joint", "put", "home", "away", "rest"]
    name: str = ""
    place: str | None = None
    share: float = 0.0
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    steps: int = DWELL

    @property
    def opens(self) -> bool:
        """Whether the move opens a joint or turns it on."""
        return self.kind == "joint" and self.share > 1


class Verdict(NamedTuple):
    """What the judge decides about a recording.

    ``success``: whether the goal was reached. ``lost``: whether it became unreachable. ``checkpoints``: number
    completed in order. ``choice``: the variant that was acted on. ``steps``: control steps until the end.
    """

    success: bool
    lost: bool
    checkpoints: int
    choice: int | None
    steps: int


class Stage:
    """The scene of one variant of a task at the start of the execution; ``recording`` holds the states since."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.sim = Simulation(task)
        self.sim.reset(SEED)
        for name, region in task.prompt.places if task.prompt else ():
            self._set_position(name, self.sim.site_pose(region)[0])
        self.start = self.sim.state()
        self.recording: Recording = []

    def restart(self) -> None:
        """Begin the execution in its first state, which lasts."""
        self.recording = []
        self.sim.set_state(self.start)
        self.sim.set_state(self.start)
        self.sim.begin_execution()

    def do(self, move: Move) -> None:
        """Carry out a move and record the state."""
        match move.kind:
            case "joint":
                self._turn(move.name, move.share)
            case "put":
                self._put(move)
            case "home" | "away":
                self.sim.data.qpos[:ARM] = self.start[1 : 1 + ARM]
                self.sim.data.qpos[0] += AWAY if move.kind == "away" else move.share
        self.sim.set_state(self.sim.state())
        self.recording.append((self.sim.state(), move.steps))

    def record(self, moves: tuple[Move, ...]) -> Recording:
        """Return the states of a sequence of moves."""
        self.restart()
        for move in moves:
            self.do(move)
        return self.recording

    def is_drawer(self, place: str) -> bool:
        """Return whether a place is inside a drawer."""
        joint = self.sim.world.joints.get(place)
        return joint is not None and joint[0].kind == "drawer"

    def half(self, place: str) -> Array:
        """Return the half size (3,) of a region along the axes of the world, m."""
        return np.abs(self.sim.site_pose(place)[1] @ self.sim.site_half_size(place))

    def way(self, name: str) -> float:
        """Return the way of a joint from its start to its bound of open or on, m or rad."""
        joint, address = self.sim.world.joints[name]
        return (joint.on_at_least if joint.kind == "knob" else joint.open_below) - float(self.start[1 + address])

    def _turn(self, name: str, share: float) -> None:
        """Turn a joint, with all objects in it; a published scene begins with joints between open and closed."""
        joint, address = self.sim.world.joints[name]
        drawer = self.is_drawer(name)
        carried = [one for one in self.task.objects if drawer and self.sim.holds(Atom("in", (one, name)))]
        before = self.sim.site_pose(name)[0] if drawer else np.zeros(3)
        shut = self.start[1 + address] if share or self.task.suite == STRICT else joint.closed_q
        self.sim.data.qpos[address] = shut + share * self.way(name)
        mujoco.mj_step1(self.sim.model, self.sim.data)
        for one in carried:
            self._set_position(one, self.sim.body_pose(one)[0] + self.sim.site_pose(name)[0] - before)

    def _put(self, move: Move) -> None:
        """Put an object, with all objects on it, on or into its target."""
        sim, name = self.sim, move.name
        riders = [one for one in self.task.objects if one != name and sim.holds(Atom("on", (one, name)))]
        before = sim.body_pose(name)[0]
        if move.place is None:
            address = self._address(name)
            sim.data.qpos[address : address + 7] = self.start[1 + address : 8 + address]
            self._set_position(name, sim.data.qpos[address : address + 3] + move.offset)
        else:
            aside = np.array([*move.offset[:2], 0.0])
            self._set_position(name, self._centre(move.place) + aside)
            if not self.is_drawer(move.place):
                self._lower(name, self._owner(move.place))
            self._set_position(name, sim.body_pose(name)[0] + (0.0, 0.0, move.offset[2]))
        for one in riders:
            self._set_position(one, sim.body_pose(one)[0] + sim.body_pose(name)[0] - before)

    def _lower(self, name: str, target: str) -> None:
        if target == TABLE:
            place = self.sim.body_pose(name)[0]
            self._set_position(name, np.array([*place[:2], TABLE_TOP - self.sim.assets[name].bottom]))
            return
        height = CLEAR
        for step in (COARSE, FINE):
            self._set_position(name, self.sim.body_pose(name)[0] + (0.0, 0.0, height))
            while not self.sim.world.touching(name, target) and height > -CLEAR:
                self._set_position(name, self.sim.body_pose(name)[0] - (0.0, 0.0, step))
                height -= step
            height = COARSE

    def _centre(self, place: str) -> Array:
        region = self.task.regions.get(place)
        if region is None and not self.is_drawer(place):
            return self.sim.body_pose(place)[0]
        if region is not None and region.target == TABLE:
            x1, y1, x2, y2 = region.ranges[0]
            return np.array([(x1 + x2) / 2, (y1 + y2) / 2, TABLE_TOP])
        return self.sim.site_pose(place)[0]

    def _owner(self, place: str) -> str:
        return self.task.regions[place].target if place in self.task.regions else place

    def _address(self, name: str) -> int:
        return int(self.sim.model.joint(int(self.sim.model.body(name).jntadr[0])).qposadr[0])

    def _set_position(self, name: str, position: Array) -> None:
        address = self._address(name)
        self.sim.data.qpos[address : address + 3] = position
        mujoco.mj_step1(self.sim.model, self.sim.data)


def judge(stage: Stage, recording: Recording, choices: bool = False) -> Verdict:
    """Judge a recording; ``choices``: whether the choice is judged as well."""
    task, sim = stage.task, stage.sim
    variants = [task, *map(task.variant, task.random_variants)]
    formulas = [goal for one in variants for goal in (one.goal, *(checkpoint.goal for checkpoint in one.checkpoints))]
    named = {atom for formula in formulas for atom in atoms(formula)}
    named |= {atom for one in variants for atom in handled_atoms(one)}
    asked = {Atom(LATCHES.get(atom.predicate, atom.predicate), atom.args) for atom in named}
    progress, choice = Progress(task), Choice(task) if choices else None
    success = lost = False
    stage.restart()
    for state, steps in recording:
        for count in (1, steps - 1):  # all steps but the first have an equal predecessor, so equal atoms
            sim.set_state(state)
            true = frozenset(filter(sim.holds, asked)) if count else frozenset()
            for _ in range(count):
                success = progress.step(true.__contains__)
                if choice is not None:
                    choice.step(true.__contains__)
                lost = progress.lost and task.suite == STRICT
                if success or lost:
                    return Verdict(success, lost, progress.index, choice.variant if choice else None, progress.steps)
    return Verdict(success, lost, progress.index, choice.variant if choice else None, progress.steps)
