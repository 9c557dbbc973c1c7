"""Demonstration prompts, acted out by the arm.

The episode that plays one restores the scene exactly afterwards, but for what was hidden; here it only has to be shown.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.grasping import pick, put_at
from lerobot_memobench.experts.hand import CLOSED, OPEN, UP, Array, Hand, Steps
from lerobot_memobench.experts.travel import HOME, go_home, pointing
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

PAUSE = 8
"""Still frames before and after, so that the demonstration prompt has a first and a last picture."""
HIGHLIGHT_STEPS = 50
BRISK = 1.25
"""How much faster than at work the hand hides things: two of them fit into a demonstration prompt."""


class PromptDemonstrator:
    """Play one demonstration prompt.

    Args:
        task: the episode's task, a variant of the published one where the referent is random.
        sim: the running scene, at the episode's initial state.
        rng: source of small variation.

    Attributes:
        shown: whether the last run showed what it had to, e.g. the goal of the routine really came about.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        assert task.prompt is not None
        self._task, self._sim, self._rng = task, sim, rng
        self._prompt = task.prompt
        self.shown = False

    def actions(self) -> Iterator[NDArray[np.float32]]:
        """Yield the demonstrator's actions (7,), one per control step."""
        hand = Hand(self._sim, self._rng)
        position, rotation = self._sim.eef_pose()
        yield from hand.wait(PAUSE, OPEN)
        match self._prompt.kind:
            case "routine":
                yield from self._routine(position, rotation)
            case "pick":
                yield from self._pick(hand)
            case "point":
                yield from self._point(hand)
            case "highlight":
                yield from self._highlight(hand)
            case "hide":
                yield from self._hide()
                return
        yield from go_home(hand, position, rotation)
        yield from hand.wait(PAUSE, OPEN)

    def _referent(self) -> str:
        assert self._prompt.target is not None
        return self._prompt.target

    def _routine(self, position: Array, rotation: Array) -> Steps:
        expert = Expert(self._task, self._sim, self._rng)
        while not expert.done:
            yield expert.act()
        self.shown = expert.succeeded
        yield from go_home(expert.hand, position, rotation)

    def _hide(self) -> Steps:
        """Put each thing into its drawer and shut that, then come home; shown if all are out of sight."""
        expert = Expert(self._task, self._sim, self._rng)
        expert.hand.speed = min(1.0, BRISK * expert.hand.speed)
        hidden = [
            atom
            for thing, drawer in self._prompt.places
            for atom in (Atom("in", (thing, drawer)), Atom("close", (drawer,)))
        ]
        for atom in (*hidden, HOME):
            yield from expert.achieve(atom)
        yield from expert.hand.wait(PAUSE, OPEN)
        self.shown = all(self._sim.holds(atom) for atom in (*hidden, HOME))

    def _pick(self, hand: Hand) -> Steps:
        place, turned = self._sim.asset_pose(self._referent())
        held = yield from pick(hand, self._referent())
        if held is not None:
            self.shown = True
            yield from hand.wait(PAUSE, CLOSED)
            yield from put_at(hand, held, place, turned)

    def _point(self, hand: Hand) -> Steps:
        asset = self._sim.assets[self._referent()]
        place, _ = self._sim.asset_pose(self._referent())
        above = place + (asset.top + 0.03) * UP
        rotation = pointing(hand, above)
        yield from hand.move(above + 0.10 * UP, rotation, CLOSED, tolerance=0.015)
        for height in (0.0, 0.05, 0.0):
            yield from hand.move(above + height * UP, rotation, CLOSED, tolerance=0.008, speed=0.6, timeout=60)
        yield from hand.wait(PAUSE, CLOSED)
        self.shown = bool(np.linalg.norm((hand.position - place)[:2]) < 0.03)
        yield from hand.move(above + 0.10 * UP, rotation, CLOSED, tolerance=0.02)

    def _highlight(self, hand: Hand) -> Steps:
        self._sim.highlights = highlights_at(self._task, self._sim, PAUSE)
        self.shown = True
        yield from hand.wait(HIGHLIGHT_STEPS, OPEN)
        self._sim.highlights = ()


def highlights_at(task: Task, sim: Simulation, frame: int) -> tuple[Highlight, ...]:
    """Return what is highlighted at a frame of a task's demonstration prompt, where things stand in ``sim``."""
    prompt = task.prompt
    if prompt is None or prompt.kind != "highlight" or prompt.target is None:
        return ()
    if not PAUSE <= frame < PAUSE + HIGHLIGHT_STEPS:
        return ()
    return (highlight_of(sim, prompt.target),)


def highlight_of(sim: Simulation, name: str) -> Highlight:
    """Return the highlight of the place where a thing stands."""
    asset, (place, _) = sim.assets[name], sim.asset_pose(name)
    spot = (float(place[0]), float(place[1]), float(place[2] + asset.bottom + 0.002))
    return Highlight(spot, asset.radius + 0.035)
