"""Is there a way to the goal that pictures alone can guide? Every answer is tried at every state that can be reached.

The best policies without memory on the resulting graph are then walked in the simulator.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.formula import SINCE_START, Atom, Formula, atoms, format_formula
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import STRICT, Task
from research.necessity.demonstrations import (
    REST,
    SETTLE,
    Home,
    Picture,
    answer_of,
    begin,
    difference,
    expert_of,
    pairwise_table,
    photograph,
    rest_steps,
)
from research.necessity.graph import (
    GoalWatch,
    Graph,
    Memories,
    Move,
    Policy,
    advance_all,
    best_map,
    best_probabilities,
    is_decided,
)
from research.necessity.memoryless import classes
from research.necessity.notes import Motion, leave_ajar, loose_object, opened_to, shift
from research.necessity.settings import Settings

if TYPE_CHECKING:
    from lerobot_memobench.experts.expert import Expert
    from lerobot_memobench.sim.simulation import Simulation, Snapshot


# --- one scene in which answers are tried out ---

SAME_PLACE = 0.02
"""Distance up to which an object is where it was for states of the exploration to be equal, m."""
SAME_JOINT = {"slide": 0.02, "hinge": 0.1}
"""The same for drawers (m) and for doors and knobs (rad)."""
LITTLE, AJAR = 0.25, 0.7
"""How far a drawer, door or knob is pulled a little and left ajar, of its way from closed to open or on."""
AT_HOME = frozenset({Atom("handhome", ()), Atom("asbegun", ())})
"""Steps that do not count while the world settles: the arm is at home at once, where a hand would be on its way. A rest
would have begun before anything decides to rest."""
ASIDE = 0.06
"""How far an object is moved that serves as a note, m."""


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
    """Places of objects, to distinguish states; of absent ones their drawers."""

    true: frozenset[Atom]
    absent: frozenset[tuple[str, str]]
    objects: NDArray[np.float64]
    joints: NDArray[np.float64]
    reach: NDArray[np.float64]

    def same(self, other: Place) -> bool:
        """Whether all relevant objects are where they were."""
        return (
            (self.true, self.absent) == (other.true, other.absent)
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
        answers: possible subtasks: `REST` where a goal asks for rest, those of the expert, and in strict tasks those
            that leave a note in the scene or look into a drawer: pull a little, leave ajar, move an object.
        starts: where each variant's execution begins; the same for all but those whose prompt changes the scene.
    """

    def __init__(self, variants: Sequence[Task], sim: Simulation, seed: int) -> None:
        self.variants, self.sim, self.seed = variants, sim, seed
        goals: list[Formula] = [task.goal for task in variants]
        self._deeds = {str(atom): atom for atom in answers_of(variants)}
        self._rest = max(rest_steps(goal) for goal in goals)
        self._notes = dict(_notes(variants[0], sim)) if variants[0].suite == STRICT else {}
        self.answers = (*self._deeds, *((REST,) if self._rest else ()), *self._notes)
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
            listen: called with the atoms that hold after each step.
            limit: steps after which the answer is broken off.
        """
        steps = 0
        for action in self._motion(answer):
            if steps >= limit:
                break
            self.sim.step(np.clip(action, -1.0, 1.0))
            steps += 1
            listen(self.true())
        for waited, _ in enumerate(self.home.settle(), 1):
            steps += 1
            listen(self.true() if waited == SETTLE else self.true() - AT_HOME)
        return steps

    def _motion(self, answer: str) -> Iterator[NDArray[np.floating]]:
        """Yield the actions of an answer; none where it holds already, or where the object is not visible."""
        from lerobot_memobench.sim.simulation import NO_OP

        if answer == REST:
            yield from (NO_OP for _ in range(self._rest))
            return
        expert = expert_of(self.variants[0], self.sim, self.seed)
        if answer in self._notes:
            yield from self._notes[answer](expert)
            return
        atom = self._deeds[answer]
        if not self.sim.holds(atom) and not self._shut_away(atom.args[0]):
            yield from expert.achieve(atom)

    def _shut_away(self, thing: str) -> bool:
        """Whether a thing lies in a closed drawer: an expert that looks into the simulator would know which."""
        if thing not in self.sim.task.objects:
            return False
        if any(thing == name for name, _ in self._absent()):
            return True
        drawers = [f"{name}_{part}" for name, asset in self.sim.assets.items() for part in asset.articulations if part]
        return any(self.sim.holds(Atom("in", (thing, it))) and self.sim.holds(Atom("close", (it,))) for it in drawers)

    def _absent(self) -> frozenset[tuple[str, str]]:
        """Return the objects that are absent until their drawers open, with these."""
        return frozenset((hidden.name, hidden.region) for hidden in self.sim.snapshot().hidden)

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
            self._absent(),
            np.array(objects).reshape(-1, 3),
            np.array([q for _, q in articulations]),
            np.array([SAME_JOINT["slide" if a.kind == "drawer" else "hinge"] for a, _ in articulations]),
        )


def _notes(task: Task, sim: Simulation) -> Iterator[tuple[str, Callable[[Expert], Motion]]]:
    """Yield by name what uses the scene as a notebook, or looks into a drawer.

    Published tasks are searched without: their goals do not prevent it.
    """
    for name in sim.world.joints:
        yield f"pull {name} a little", partial(_open_by, name, LITTLE)
        yield f"leave {name} ajar", partial(_open_by, name, AJAR)
    name = loose_object(task)
    yield f"move {name}", lambda expert: shift(expert, name, ASIDE)


def _open_by(name: str, share: float, expert: Expert) -> Motion:
    yield from leave_ajar(expert, name, opened_to(expert, name, share))


# --- exploration ---


@dataclass
class Exploration:
    """Result of a search.

    Attributes:
        graph: states and moves; pictures are numbered by node until somebody groups them.
        starts: node at which each goal's execution begins.
        pictures: images at each node. true: which atoms of the goals hold there.
        moves, steps: how many of either were simulated.
        exhausted: every relevant state before the horizon was explored; the budget did not end the search.
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
        found: results so far.
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

    Such a policy acts alike for all goals, so it is run once and every goal is checked on the way.

    Args:
        tasks: whose goals are looked for within the horizon.
        policy: pictures with the arm at home → answer; None where it has none.
    """
    waiting = [Progress(task) for task in tasks]
    steps = reached = 0

    def listen(true: frozenset[Atom]) -> None:
        nonlocal steps, reached
        steps += 1
        if steps <= horizon:
            reached += sum([progress.step(true.__contains__) for progress in waiting])
            waiting[:] = [progress for progress in waiting if not progress.success and not progress.lost]

    while waiting and steps < horizon:
        answer = policy(photograph(laboratory.sim))
        if answer is None:
            break
        laboratory.do(answer, listen, horizon - steps)
    return reached


# --- the search for a policy without memory ---


def search(laboratory: Laboratory, settings: Settings) -> dict[str, Any]:
    """Return the best policies without memory that were found, and whether the simulator confirms the best maps.

    A policy reads the instruction: goals with the same one share a policy, others have one of their own.
    """
    found = explore(laboratory, settings.budget, settings.horizon)
    graph = found.graph
    graph.pictures = classes(pairwise_table(found.pictures, difference), settings.tolerance)
    groups = [_best(laboratory, found, group, settings) for group in _by_instruction(laboratory)]
    goals = len(laboratory.variants)
    return {
        "seed": laboratory.seed,
        "deterministic": sum(len(group["goals"]) * group["deterministic"] for group in groups) / goals,
        "confirmed": sum(group["confirmed"] for group in groups),
        "of": goals,
        "stochastic": sum(len(group["goals"]) * group["stochastic"] for group in groups) / goals,
        "states": len(graph.pictures),
        "pictures": len(set(graph.pictures)),
        "moves": found.moves,
        "steps": found.steps,
        "complete": graph.complete,
        "exhausted": found.exhausted,
        "unexplored": 0 if found.exhausted else len(graph.unexplored),
        "policy": [rule for group in groups for rule in group["policy"]],
    }


def _by_instruction(laboratory: Laboratory) -> list[list[int]]:
    """Return the goals, as places in the row of variants, that one instruction asks for."""
    groups: dict[str, list[int]] = {}
    for place, variant in enumerate(laboratory.variants):
        groups.setdefault(variant.language, []).append(place)
    return list(groups.values())


def _best(laboratory: Laboratory, found: Exploration, group: Sequence[int], settings: Settings) -> dict[str, Any]:
    """Return how far the best policies come at the goals of one instruction."""
    goals = [laboratory.variants[place].goal for place in group]
    starts = [found.starts[place] for place in group]
    share, policy = best_map(found.graph, goals, settings.horizon, starts)
    return {
        "goals": group,
        "deterministic": share,
        "confirmed": _confirmed(laboratory, found, group, policy, settings) if share > 0 else 0,
        "stochastic": best_probabilities(found.graph, goals, settings.horizon, starts),
        "policy": [{"when": _when(found, picture), "do": answer} for picture, answer in policy.items()],
    }


def _confirmed(
    laboratory: Laboratory, found: Exploration, group: Sequence[int], policy: Policy, settings: Settings
) -> int:
    """Return how many goals come true in the simulator when the map acts; it knows the nearest picture it explored."""

    def act(seen: Sequence[Picture]) -> str | None:
        apart = [difference(seen, known) for known in found.pictures]
        nearest = int(np.argmin(apart))
        return policy.get(found.graph.pictures[nearest]) if apart[nearest] <= settings.tolerance else None

    confirmed = 0
    for start in dict.fromkeys(found.starts[place] for place in group):
        together = [place for place in group if found.starts[place] == start]
        laboratory.sim.restore(laboratory.starts[together[0]])
        tasks = [laboratory.variants[place] for place in together]
        confirmed += walk(laboratory, tasks, act, settings.horizon)
    return confirmed


def _when(found: Exploration, picture: int) -> list[str]:
    """Return which atoms of the goals hold where a picture is seen, a text for each combination, sorted."""
    nodes = [node for node, its_picture in enumerate(found.graph.pictures) if its_picture == picture]
    return sorted({" ".join(sorted(map(format_formula, found.true[node]))) for node in nodes})
