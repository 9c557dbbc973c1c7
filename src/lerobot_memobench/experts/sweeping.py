"""Open a door in one pull and shut it in one push: half the steps of `experts.doors`, for rounds that are counted.

The hand leans out as far as the door goes, where that of the published demonstrations lets go and takes it anew.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.experts.doors import Door, close_door, door_now, open_door, wanted
from lerobot_memobench.experts.grasping import HOVER
from lerobot_memobench.experts.hand import CLOSED, EASY_CLOSING, OPEN, UP, Array, Hand, length
from lerobot_memobench.experts.leaning import leaning, reach_lean
from lerobot_memobench.experts.travel import LOST, Doing, Steps, let_go

LEAD = 0.16
"""Angle by which the hand leads a door along its arc, rad."""
GRIP_BELOW = 0.018
"""How far under a handle's upper end it is taken, m."""
PUSH_IN, PUSH_BELOW = 0.045, 0.030
"""Where a door is pushed: beside the handle towards the hinge by so much, and so far below its upper edge, m."""
BEFORE, TOUCHING = 0.06, 0.018
"""Distance of the hand from the panel's middle before and while it pushes, m."""
STEPS = 150
"""Control steps after which a pull or push is given up."""


def pull_open(hand: Hand, name: str) -> Doing:
    """Take a door's handle and follow the arc until the door counts as open; a second way where that fails."""
    articulation, _ = hand.sim.world.articulation(name)
    yield from _pull(hand, name)
    yield from let_go(hand, 0.08)
    if wanted(hand.sim.world.articulation(name)[1], articulation, True):
        return True
    return (yield from open_door(hand, name))


def push_shut(hand: Hand, name: str) -> Doing:
    """Push a door's panel from outside until it is shut; a second way where that fails."""
    articulation, _ = hand.sim.world.articulation(name)
    yield from _push(hand, name)
    if wanted(hand.sim.world.articulation(name)[1], articulation, False):
        return True
    return (yield from close_door(hand, name))


def _turned(hand: Hand, door: Door, place: Array, flip: float) -> Array:
    """Return the rotation (3, 3) of a hand that closes along the door and leans as far as a place needs."""
    closing = flip * door.along
    lean = reach_lean(hand, place)
    return leaning(closing, lean - (lean @ closing) * closing)


def _pull(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    up = (articulation.handle.length / 2 - GRIP_BELOW) * UP
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def grip(ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_now(hand, name, ahead)
        return door.handle + up, _turned(hand, door, door.handle + up, flip)

    def at(back: float) -> Callable[[], Array]:
        def target() -> Array:
            place, turn = grip()
            return place - back * turn[:, 2]

        return target

    yield from hand.move(at(HOVER), lambda: grip()[1], OPEN, tolerance=0.02, turn_tolerance=0.1)
    yield from hand.move(at(0.0), lambda: grip()[1], OPEN, tolerance=0.006, speed=0.8, timeout=60)
    yield from hand.close()
    way = np.sign(articulation.open_q - articulation.closed_q)
    for _ in range(STEPS):
        _, q = hand.sim.world.articulation(name)
        if wanted(q, articulation, True) or length(hand.position - grip()[0]) > LOST:
            break
        yield hand.toward(*grip(way * LEAD), CLOSED)


def _push(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    way = float(np.sign(articulation.closed_q - articulation.open_q))
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def pose(gap: float, height: float = 0.0, ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_now(hand, name, ahead)
        place = door.edge - PUSH_IN * door.along + gap * door.outward + (height - PUSH_BELOW) * UP
        return place, _turned(hand, door, place, flip)

    for height, tolerance in ((0.12, 0.03), (0.0, 0.02)):
        target, turn = pose(BEFORE, height)
        yield from hand.move(target, turn, CLOSED, tolerance=tolerance, turn_tolerance=0.15)
    for _ in range(STEPS):
        if wanted(hand.sim.world.articulation(name)[1], articulation, False):
            break
        yield hand.toward(*pose(TOUCHING, 0.0, way * LEAD), CLOSED)
    back = hand.position + 0.05 * door_now(hand, name).outward
    yield from hand.move(back, hand.rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=40)
