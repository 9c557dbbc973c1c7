"""What is seen when the expert turns to something new, and what else could be done then: from the real simulator.

`follow` runs the expert and photographs every decision twice: as it happens, and with the arm put back to where the
execution began, so that the picture shows the world and not where the arm happens to be. `explore` tries every answer
at every state it comes to, from that same pose of the arm. `necessity` and `necessity_search` reason about what they
find. The simulator is imported when it is needed.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.evaluation.necessity.search import Graph, Move
from lerobot_memobench.tasks.formula import LATCHES, Atom, Formula, atoms
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Task

if TYPE_CHECKING:
    from lerobot_memobench.experts.expert import Expert
    from lerobot_memobench.sim.simulation import Simulation, Snapshot

Picture = NDArray[np.uint8]

CAMERAS = ("agentview", "wrist")
HORIZON = 1200
SETTLE = 12
"""Steps for which the world comes to rest before a picture with the arm at home; more than a `Then` asks for."""

SHIFT = 2
"""Pixels by which what is seen may have moved and still count as the same."""
COLOUR = 24
"""Largest difference of a colour channel, of 255, that still counts as the same."""
SAME_PLACE = 0.02
"""Distance up to which an object is where it was when states of the exploration are told apart, m."""
SAME_JOINT = {"slide": 0.02, "hinge": 0.2}
"""The same for drawers (m) and for doors and knobs (rad)."""


# --- pictures ---


def unmatched(a: Picture, b: Picture, shift: int = SHIFT, colour: int = COLOUR) -> float:
    """Return the share of pixels of either picture without a like pixel near the same place in the other, in [0, 1].

    Args:
        a, b: (height, width, 3).
        shift: how far away a like pixel may be, pixels.
        colour: how far its channels may differ.
    """
    first, second = a.astype(np.int16), b.astype(np.int16)
    rows, columns = np.nonzero(np.abs(first - second).max(axis=-1) > colour)
    if not len(rows):
        return 0.0
    worst = 0
    for here, there in ((first, second), (second, first)):
        padded = np.pad(there, ((shift, shift), (shift, shift), (0, 0)), mode="edge")
        found = np.zeros(len(rows), dtype=bool)
        for dy in range(2 * shift + 1):
            for dx in range(2 * shift + 1):
                near = padded[rows + dy, columns + dx] - here[rows, columns]
                found |= np.abs(near).max(axis=-1) <= colour
        worst = max(worst, int((~found).sum()))
    return worst / first.shape[0] / first.shape[1]


def difference(a: Sequence[Picture], b: Sequence[Picture]) -> float:
    """Return how much two moments differ to the eye: the larger `unmatched` of the cameras."""
    return max(unmatched(x, y) for x, y in zip(a, b, strict=True))


def largest_pixel_difference(a: Sequence[Picture], b: Sequence[Picture]) -> int:
    """Return the largest difference of any channel of any pixel of the cameras, 0 to 255."""
    return max(int(np.abs(x.astype(np.int16) - y).max()) for x, y in zip(a, b, strict=True))


def differences(moments: Sequence[Sequence[Picture]]) -> NDArray[np.float64]:
    """Return `difference` of all pairs, (n, n)."""
    table = np.zeros((len(moments), len(moments)))
    for i in range(len(moments)):
        for j in range(i):
            table[i, j] = table[j, i] = difference(moments[i], moments[j])
    return table


# --- the arm at home ---


class Home:
    """Puts the arm back to where the execution began; the world stays as it is.

    Args:
        sim: a simulation that was just reset.
    """

    def __init__(self, sim: Simulation) -> None:
        from lerobot_memobench.sim.robot import ARM_JOINTS, FINGER_JOINTS

        self._sim, self._start = sim, sim.snapshot()
        joints = [sim.model.joint(name) for name in (*ARM_JOINTS, *FINGER_JOINTS)]
        # A snapshot begins with time, positions and velocities.
        self._places = [1 + int(joint.qposadr[0]) for joint in joints]
        self._places += [1 + sim.model.nq + int(joint.dofadr[0]) for joint in joints]

    def go(self) -> None:
        """Put joints, velocities and the controller's goal of the arm back."""
        now = self._sim.snapshot()
        physics = now.physics.copy()
        physics[self._places] = self._start.physics[self._places]
        self._sim.restore(dataclasses.replace(self._start, physics=physics))

    def settle(self) -> Iterator[None]:
        """Come home and hold still for `SETTLE` steps, yielding after each; end exactly at home."""
        from lerobot_memobench.sim.simulation import NO_OP

        self.go()
        for _ in range(SETTLE):
            self._sim.step(NO_OP)
            yield
        self.go()

    def look(self) -> tuple[Picture, ...]:
        """Return what the cameras would see with the arm at home; the simulation goes on as if nothing had been."""
        before = self._sim.snapshot()
        for _ in self.settle():
            pass
        pictures = photograph(self._sim)
        self._sim.restore(before)
        return pictures


def photograph(sim: Simulation) -> tuple[Picture, ...]:
    """Return what the cameras see now."""
    return tuple(sim.render(camera) for camera in CAMERAS)


# --- the expert's decisions ---


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


def _expert(task: Task, sim: Simulation, seed: int) -> Expert:
    """Return the expert as an episode of this seed has it."""
    from lerobot_memobench.experts.expert import Expert

    class Noting(Expert):
        turned_to: Atom | None = None

        def achieve(self, atom: Atom):  # type: ignore[no-untyped-def]
            if not self._holds(atom):
                self.turned_to = answer_of(atom)
            yield from super().achieve(atom)

    return Noting(task, sim, np.random.default_rng([seed, zlib.crc32(task.name.encode()), 3]))


def follow(task: Task, sim: Simulation, seed: int, horizon: int = HORIZON) -> Demonstration:
    """Let the expert do a task (or a variant of it) from a seed's start, and look at each of its decisions."""
    sim.reset(seed)
    home, progress = Home(sim), Progress(task)
    progress.reset()
    expert = _expert(task, sim, seed)
    moments: list[Moment] = []
    turned: list[Atom] = []
    while not progress.success and progress.steps < horizon and not expert.done:
        action = expert.act()
        turned_to: Atom | None = getattr(expert, "turned_to", None)
        if turned_to is not None and not expert.done:
            seen, proprio = photograph(sim), sim.proprio()
            turned.append(turned_to)
            moments.append(Moment(str(turned_to), progress.steps, seen, home.look(), proprio))
            expert.turned_to = None  # type: ignore[attr-defined]
        sim.step(action)
        progress.step(sim.holds)
    # While a `Then` still counts how long its last part holds, the expert may turn to something that is not asked for.
    while progress.success and moments and not sim.holds(turned[-1]):
        moments.pop()
        turned.pop()
    return Demonstration(tuple(moments), progress.success, progress.steps)


# --- what else could be done ---


def answers_of(variants: Sequence[Task]) -> list[Atom]:
    """Return everything the expert brings about in some variant: the decision set."""
    from lerobot_memobench.experts.expert import steps_of

    found: dict[Atom, None] = {}
    for task in variants:
        for formula in (*(checkpoint.goal for checkpoint in task.checkpoints), task.goal):
            found.update((answer_of(atom), None) for atom in steps_of(formula))
    return list(found)


@dataclass(frozen=True)
class _Place:
    """Where things are, for telling states apart."""

    true: frozenset[Atom]
    objects: NDArray[np.float64]
    joints: NDArray[np.float64]
    reach: NDArray[np.float64]

    def same(self, other: _Place) -> bool:
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
    """

    def __init__(self, variants: Sequence[Task], sim: Simulation, seed: int) -> None:
        self.variants, self.sim, self.seed = variants, sim, seed
        self.answers = {str(atom): atom for atom in answers_of(variants)}
        formulas: list[Formula] = [task.goal for task in variants]
        self._atoms = sorted({answer_of(atom) for formula in formulas for atom in atoms(formula)}, key=str)
        sim.reset(seed)
        self.home = Home(sim)
        self.start = sim.snapshot()

    def true(self) -> frozenset[Atom]:
        """Return the atoms of the goals that hold now."""
        return frozenset(atom for atom in self._atoms if self.sim.holds(atom))

    def do(self, answer: str, listen: Callable[[frozenset[Atom]], None], limit: int = HORIZON) -> int:
        """Let the expert carry out an answer, come home, and settle; return the steps it took.

        Args:
            listen: told the atoms that hold after each step.
            limit: steps after which the answer is broken off.
        """
        atom = self.answers[answer]
        steps = 0
        if not self.sim.holds(atom):
            expert = _expert(self.variants[0], self.sim, self.seed)
            for action in expert.achieve(atom):
                if steps >= limit:
                    break
                self.sim.step(np.clip(action, -1.0, 1.0))
                steps += 1
                listen(self.true())
        for _ in self.home.settle():
            steps += 1
            listen(self.true())
        return steps

    def place(self) -> _Place:
        """Return where things are now."""
        sim = self.sim
        objects = [sim.body_pose(name)[0] for name, asset in sim.assets.items() if asset.kind != "fixture"]
        articulations = [
            sim.world.articulation(f"{name}_{region}" if region else name)
            for name, asset in sim.assets.items()
            for region in asset.articulations
        ]
        return _Place(
            self.true(),
            np.array(objects).reshape(-1, 3),
            np.array([q for _, q in articulations]),
            np.array([SAME_JOINT["slide" if a.kind == "drawer" else "hinge"] for a, _ in articulations]),
        )


@dataclass
class Exploration:
    """What was found.

    Attributes:
        graph: states and moves; pictures are numbered by node until somebody groups them.
        pictures: what is seen at each node. true: which atoms of the goals hold there.
        moves, steps: how many of either were simulated.
    """

    graph: Graph
    pictures: list[tuple[Picture, ...]]
    true: list[frozenset[Atom]]
    moves: int = 0
    steps: int = 0


def explore(laboratory: Laboratory, budget: int, horizon: int = HORIZON) -> Exploration:
    """Try every answer at every state that can be reached before the horizon, nearest states first.

    Args:
        budget: control steps after which no further state is begun; those that are left stay without moves.
    """
    sim = laboratory.sim
    sim.restore(laboratory.start)
    graph = Graph([0])
    found = Exploration(graph, [photograph(sim)], [laboratory.true()])
    snapshots: list[Snapshot] = [laboratory.start]
    places, cost = [laboratory.place()], [0]
    while True:
        waiting = [node for node in range(len(snapshots)) if node not in graph.moves and cost[node] < horizon]
        if not waiting or found.steps >= budget:
            return found
        node = min(waiting, key=lambda k: cost[k])
        moves: dict[str, Move] = {}
        for answer in laboratory.answers:
            sim.restore(snapshots[node])
            trace: list[tuple[frozenset[Atom], int]] = []

            def listen(true: frozenset[Atom], trace: list[tuple[frozenset[Atom], int]] = trace) -> None:
                if trace and trace[-1][0] == true:
                    trace[-1] = (true, trace[-1][1] + 1)
                else:
                    trace.append((true, 1))

            steps = laboratory.do(answer, listen, horizon - cost[node])
            if steps > SETTLE:
                found.moves, found.steps = found.moves + 1, found.steps + steps
            place = laboratory.place()
            to = next((k for k, known in enumerate(places) if known.same(place)), len(places))
            if to == len(places):
                graph.pictures.append(to)
                found.pictures.append(photograph(sim))
                found.true.append(place.true)
                snapshots.append(sim.snapshot())
                places.append(place)
                cost.append(cost[node] + steps)
            cost[to] = min(cost[to], cost[node] + steps)
            moves[answer] = Move(to, steps, tuple(trace))
        graph.moves[node] = moves


def walk(
    laboratory: Laboratory,
    task: Task,
    policy: Callable[[tuple[Picture, ...]], str | None],
    horizon: int = HORIZON,
) -> bool:
    """Let a policy without memory act from pictures alone; return whether the task's goal came true in time.

    Args:
        policy: pictures with the arm at home → answer; None where it has none.
    """
    laboratory.sim.restore(laboratory.start)
    progress = Progress(task)
    progress.reset()
    done = False

    def listen(_: frozenset[Atom]) -> None:
        nonlocal done
        done = done or (progress.step(laboratory.sim.holds) and progress.steps <= horizon)

    while not done and progress.steps < horizon:
        answer = policy(photograph(laboratory.sim))
        if answer is None:
            return False
        laboratory.do(answer, listen, horizon - progress.steps)
    return done
