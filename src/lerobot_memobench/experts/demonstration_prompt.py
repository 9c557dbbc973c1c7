"""Generate the actions of demonstration prompts.

The episode restores the scene exactly after a prompt, except for hidden objects.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.grasping import pick, put_at
from lerobot_memobench.experts.hand import CLOSED, OPEN, UP, Hand, Steps
from lerobot_memobench.experts.travel import HAND_HOME, go_home, pointing
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task
from mujoco_raster.highlights import Highlight

PAUSE_STEPS = 8
"""Steps at rest before and after a prompt, so that it has a first and a last frame."""
HIGHLIGHT_STEPS = 50
HIDING_SPEED_FACTOR = 1.25
"""Speed factor while hiding objects, so that two hidings fit into a prompt."""


class PromptDemonstrator:
    """Play the demonstration prompt of a task, a variant if the referent is random.

    The simulation runs and is in the episode's initial state.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        assert task.prompt is not None
        self._task, self._sim, self._rng = task, sim, rng
        self._prompt = task.prompt
        self._referent = task.prompt.target or ""
        self.succeeded = False
        """Whether the last prompt succeeded, for example whether a routine reached its goal."""

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
