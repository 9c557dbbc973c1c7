"""Ways through the air: up, over what stands there, and home; and what is in the hand on the way."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.experts.hand import OPEN, UP, Array, Hand, length
from lerobot_memobench.experts.surroundings import FINGER_REACH, clear_height, corners
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.tasks.formula import Atom

Steps = Generator[NDArray[np.float32], None, None]
"""A part of a motion: yields actions (7,)."""
Doing = Generator[NDArray[np.float32], None, bool]
"""A motion: yields actions (7,), returns whether it did what it is for."""
LOST = 0.05
"""Distance between hand and thing, beyond that at the grasp, at which it counts as dropped, m."""
HOME = Atom("handhome", ())
SETTLING = 18
"""Control steps within which a hand comes to rest at home, once it is near."""
HAND_BESIDE = 0.05
"""How far the hand reaches sideways on its way, m."""
PRESSED = 2
"""Steps for which what has a stop is pushed on against it: fewer than the six that a policy executes of a plan, or
whoever does not see the difference would plan them again and again."""


@dataclass
class Held:
    """What the hand holds and how."""

    name: str
    offset: Array
    """Origin of the thing in the hand's frame, (3,), m."""
    turn: Array
    """Rotation of the thing in the hand's frame, (3, 3)."""


def holding(hand: Hand, held: Held) -> bool:
    """Return whether the thing is still where it was in the hand when it was taken."""
    position, rotation = hand.sim.eef_pose()
    now, _ = hand.sim.body_pose(held.name)
    return length(rotation.T @ (now - position) - held.offset) < LOST


def pressed(reached: Callable[[], bool]) -> Callable[[], bool]:
    """Return what tells, asked at every step, that something has been reached for `PRESSED` steps.

    Who sees a knob or a door less exactly than the expert, and ends some steps earlier, has it shut all the same.
    """
    since = 0

    def asked() -> bool:
        nonlocal since
        since = since + 1 if reached() else 0
        return since > PRESSED

    return asked


def rise(hand: Hand, gripper: float, least: float = 0.12) -> Steps:
    """Go straight up to a height over the table at which nothing is in the way."""
    position, rotation = hand.sim.eef_pose()
    height = TABLE_TOP + least
    if position[2] < height:
        target = np.array([position[0], position[1], height])
        yield from hand.move(target, rotation, gripper, tolerance=0.02, turn_tolerance=1.0, timeout=60)


def travel(
    hand: Hand,
    place: Callable[[], Array],
    turned: Callable[[], Array],
    gripper: float,
    *,
    target: str,
    held: Held | None = None,
    give_up: Callable[[], bool] | None = None,
) -> Steps:
    """Go over to above a place, as high as what stands on the way asks for; nothing when the way is free."""
    start, end = hand.position, place()
    lowest, wide, but = _load(hand, held)
    height = clear_height(hand, start, end, lowest=lowest, wide=wide, but=(target, *but))
    if height <= min(start[2], end[2]) + 0.01:
        return
    if start[2] < height - 0.01:
        up = np.array([start[0], start[1], height])
        yield from hand.move(
            up, hand.rotation, gripper, tolerance=0.02, turn_tolerance=1.0, timeout=60, give_up=give_up
        )

    def over() -> Array:
        end = place()
        return np.array([end[0], end[1], max(end[2], height)])

    yield from hand.move(over, turned, gripper, tolerance=0.02, turn_tolerance=0.15, give_up=give_up)


def _load(hand: Hand, held: Held | None) -> tuple[float, float, tuple[str, ...]]:
    """Return how far the hand with its load reaches down and sideways, m, and the load's name, if any."""
    if held is None:
        return FINGER_REACH, HAND_BESIDE, ()
    asset = hand.sim.assets[held.name]
    position, rotation = hand.sim.body_pose(held.name)
    below = float(hand.position[2] - position[2] - (rotation @ corners(asset))[2].min())
    return max(FINGER_REACH, below), max(HAND_BESIDE, asset.radius), (held.name,)


def let_go(hand: Hand, height: float = 0.12) -> Steps:
    """Open the fingers and go straight up, clear of what was held."""
    yield from hand.open(6)
    up = hand.position + height * UP
    yield from hand.move(up, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)


def release(hand: Hand, up: float = 0.12) -> Steps:
    """Open the fingers and go up.

    The hand rises while the fingers still open: fully open inside a bowl they would press against its wall and take
    it along.
    """
    yield from hand.open(3)
    target = hand.position + up * UP
    yield from hand.move(target, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, speed=0.7, timeout=60)


def go_home(hand: Hand, position: Array, rotation: Array) -> Steps:
    """Rise and go back to a pose with the fingers open."""
    yield from rise(hand, OPEN, 0.2)
    yield from hand.move(position, rotation, OPEN, tolerance=0.012, turn_tolerance=0.08)


def come_home(hand: Hand, position: Array, rotation: Array) -> Steps:
    """Go back to where the hand was at first and come to rest; nothing when it stands there.

    Short of `Hold`-long rests: it ends after `SETTLING` steps, however near it is.
    """
    if hand.sim.holds(HOME):
        return
    yield from go_home(hand, position, rotation)
    for _ in range(SETTLING):
        if hand.sim.holds(HOME):
            break
        yield hand.toward(position, rotation, OPEN)
