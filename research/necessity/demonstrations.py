"""The expert's decisions from one start, photographed twice: as it happens, and with the arm put back to its start.

Two pictures look the same where what moved by a pixel or two, or is a shade darker, is the only difference.
"""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from lerobot_memobench.protocol import HORIZON
from lerobot_memobench.tasks.formula import LATCHES, SINCE_START, Atom, Formula, Hold, children
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import Prompt, Task

if TYPE_CHECKING:
    from lerobot_memobench.experts.expert import Expert
    from lerobot_memobench.experts.travel import Steps
    from lerobot_memobench.sim.simulation import Simulation, Snapshot


# --- the start of an execution: as the scene was drawn, or as a hiding left it ---

HIDINGS = 12
"""Hidings kept per process: a demonstration and a search begin at the same ones."""


def begin(task: Task, sim: Simulation, seed: int) -> None:
    """Bring a simulation to where the execution of a task (or a variant of it) begins."""
    sim.reset(seed)
    if task.prompt is not None and not task.prompt.restores:
        sim.restore(_after_hiding(task.variant(0), task.prompt, seed))
        sim.begin_execution()


@lru_cache(maxsize=HIDINGS)
def _after_hiding(task: Task, prompt: Prompt, seed: int) -> Snapshot:
    """Play a prompt as an episode of this seed does, and return the scene after it."""
    from lerobot_memobench.envs.episode import Episode
    from lerobot_memobench.protocol import ACTION_DIM, PROMPT

    episode = Episode(dataclasses.replace(task, prompt=prompt, drawn=False))
    episode.reset(seed)
    while episode.phase == PROMPT:
        episode.step(np.zeros(ACTION_DIM))
    return episode.sim.snapshot()


# --- pictures ---

Picture = NDArray[np.uint8]
"""(height, width, 3)."""

CAMERAS = ("agentview", "wrist")

SHIFT = 2
"""Pixels by which an image may be displaced and still count as the same."""
COLOUR = 24
"""Largest difference of a colour channel, of 255, that still counts as the same."""


def photograph(sim: Simulation) -> tuple[Picture, ...]:
    """Return the present images of both cameras."""
    return tuple(sim.render(camera) for camera in CAMERAS)


def unmatched(a: Picture, b: Picture, shift: int = SHIFT, colour: int = COLOUR) -> float:
    """Return the share of pixels of either picture without a like pixel near the same place in the other, in [0, 1].

    Args:
        a, b: (height, width, 3).
        shift: how far away a like pixel may be, pixels.
        colour: how far its channels may differ.
    """
    if np.array_equal(a, b):
        return 0.0
    first, second = a.astype(np.int16), b.astype(np.int16)
    worst = max(_lacking(first, second, shift, colour), _lacking(second, first, shift, colour))
    return float(worst / first.shape[0] / first.shape[1])


@njit
def _lacking(here: NDArray[np.int16], there: NDArray[np.int16], shift: int, colour: int) -> int:
    """Return how many pixels of one picture have no like pixel near the same place in the other."""
    height, width, _ = here.shape
    lacking = 0
    for y in range(height):
        for x in range(width):
            if not _like(here, y, x, there, y, x, colour):  # most are like the one at the very place
                lacking += not _near(here, y, x, there, shift, colour)
    return lacking


@njit
def _near(here: NDArray[np.int16], y: int, x: int, there: NDArray[np.int16], shift: int, colour: int) -> bool:
    for v in range(max(y - shift, 0), min(y + shift + 1, there.shape[0])):
        for u in range(max(x - shift, 0), min(x + shift + 1, there.shape[1])):
            if _like(here, y, x, there, v, u, colour):
                return True
    return False


@njit
def _like(here: NDArray[np.int16], y: int, x: int, there: NDArray[np.int16], v: int, u: int, colour: int) -> bool:
    like = True
    for channel in range(3):
        like &= abs(here[y, x, channel] - there[v, u, channel]) <= colour
    return like


def difference(a: Sequence[Picture], b: Sequence[Picture]) -> float:
    """Return how much two frames differ to the eye: the larger `unmatched` of the cameras."""
    return max(unmatched(x, y) for x, y in zip(a, b, strict=True))


def largest_pixel_difference(a: Sequence[Picture], b: Sequence[Picture]) -> int:
    """Return the largest difference of any channel of any pixel of the cameras, 0 to 255."""
    return max(int(np.abs(x.astype(np.int16) - y).max()) for x, y in zip(a, b, strict=True))


def pairwise_table[Item](items: Sequence[Item], measure: Callable[[Item, Item], float]) -> NDArray[np.float64]:
    """Return a symmetric measure, such as `difference`, of all pairs, (n, n), with zeros on the diagonal."""
    table = np.zeros((len(items), len(items)))
    for i, j in combinations(range(len(items)), 2):
        table[i, j] = table[j, i] = measure(items[i], items[j])
    return table


# --- the arm at home ---

SETTLE = 12
"""Steps for which the world comes to rest before a picture with the arm at home; more than a `Then` asks for."""


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
        self._sim.restore(dataclasses.replace(self._start, physics=physics, hidden=now.hidden))

    def settle(self) -> Iterator[None]:
        """Come home and hold still for `SETTLE` steps, yielding after each; end exactly at home."""
        from lerobot_memobench.sim.simulation import NO_OP

        self.go()
        for _ in range(SETTLE):
            self._sim.step(NO_OP)
            yield
        self.go()

    def look(self) -> tuple[Picture, ...]:
        """Return the images with the arm at home; the simulation is restored afterwards."""
        before = self._sim.snapshot()
        for _ in self.settle():
            pass
        pictures = photograph(self._sim)
        self._sim.restore(before)
        return pictures


# --- demonstrations ---


@dataclass(frozen=True)
class Frame:
    """A decision of the expert.

    Attributes:
        answer: the subtask that it begins.
        step: control steps of the execution so far.
        observations: pictures as it happens. at_home: pictures with the arm at home.
        proprio: (8,) as it happens; at home it is the same at every decision of an episode.
    """

    answer: str
    step: int
    observations: tuple[Picture, ...]
    at_home: tuple[Picture, ...]
    proprio: NDArray[np.float32]


@dataclass(frozen=True)
class Demonstration:
    """An episode of the expert: its decisions, whether the goal came true in time, and after how many steps."""

    frames: tuple[Frame, ...]
    success: bool
    steps: int


REST = "rest"
"""The answer to rest."""
HOME = Atom("handhome", ())
STILL = 0.001
"""Change of proprioception (m, rad) in a step up to which the hand is at rest."""


def rest_steps(formula: Formula) -> int:
    """Return for how many steps a goal asks to hold still, 0 where it does not."""
    inside = max((rest_steps(child) for child in children(formula)), default=0)
    return max(inside, formula.number) if isinstance(formula, Hold) else inside


def answer_of(atom: Atom) -> Atom:
    """Return the atom to bring about: of a latch, its own atom."""
    return Atom(LATCHES.get(atom.predicate, atom.predicate), atom.args)


def expert_of(task: Task, sim: Simulation, seed: int, listen: Callable[[Atom], object] | None = None) -> Expert:
    """Return the expert as an episode of this seed has it.

    Args:
        listen: called with each subtask that the expert begins.
    """
    from lerobot_memobench.experts.expert import Expert

    class Noting(Expert):
        """Reports its subtasks."""

        def achieve(self, atom: Atom) -> Steps:
            """Bring one atom about, and report it unless it holds already or is only a posture."""
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
            watcher.note(turns[-1], progress.steps)  # a subtask on the way to another one is done first
            turns.clear()
        sim.step(action)
        progress.step(sim.holds)
        watcher.look_for_rest(progress.steps)
    return Demonstration(watcher.frames(progress.success), progress.success, progress.steps)


class _Watcher:
    """Photographs decisions, and where a goal asks for rest, the hand come home at last as the decision to rest."""

    def __init__(self, task: Task, sim: Simulation) -> None:
        self._sim, self._home = sim, Home(sim)
        self._rests = rest_steps(task.goal) > 0
        self._was_home, self._before = True, sim.proprio()
        self._noted: list[tuple[Atom, Frame]] = []
        self._rest: Frame | None = None

    def note(self, answer: Atom, step: int) -> None:
        """Note the subtask that the expert begins."""
        self._noted.append((answer, self._photograph(str(answer), step)))
        self._rest = None

    def look_for_rest(self, step: int) -> None:
        """Keep images of the hand at rest at home: without a further subtask, here it decided to rest."""
        if not self._rests:
            return
        now = self._sim.proprio()
        still = bool(np.abs(now - self._before).max() <= STILL)
        if self._sim.holds(HOME) and still and not self._was_home:
            self._rest = self._photograph(REST, step)
        self._was_home = self._sim.holds(HOME) and (still or self._was_home)
        self._before = now

    def frames(self, success: bool) -> tuple[Frame, ...]:
        """Return the decisions of an episode that has ended."""
        # While a `Then` counts how long its last part holds, the expert may begin a subtask that is not requested.
        while success and self._noted and not self._sim.holds(self._noted[-1][0]):
            self._noted.pop()
        rest = () if self._rest is None else (self._rest,)
        return (*(frame for _, frame in self._noted), *rest)

    def _photograph(self, answer: str, step: int) -> Frame:
        return Frame(answer, step, photograph(self._sim), self._home.look(), self._sim.proprio())
