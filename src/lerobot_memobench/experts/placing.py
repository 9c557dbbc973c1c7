"""Place: bring a held thing to where it belongs and set it down there."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.hand import CLOSED, DOWN, UP, Array, Hand, Target, cross, frame, unit
from lerobot_memobench.experts.travel import Doing, Held, holding, release, travel

MOST_RIGHTING = np.radians(35)
"""Tilt of a held thing up to which it is set upright before it is set down, rad."""


def carry(
    hand: Hand,
    held: Held,
    destination: Target,
    turn: Array,
    clearance: float,
    tolerance: float = 0.006,
    support: str = "",
) -> Doing:
    """Bring the held thing's origin over a destination (3,) and down to it; stop early when it was lost.

    Args:
        hand: the arm.
        held: what is carried.
        destination: where the thing's origin shall be, asked anew at every step.
        turn: rotation (3, 3) of the hand on arrival.
        clearance: height over the destination at which the way goes, m.
        tolerance: how near the origin must come, m.
        support: what it is put on, which is not in the way.
    """

    at = _hand_over(hand, held, destination, turn)

    def lost() -> bool:
        return not holding(hand, held)

    position, rotation = hand.sim.eef_pose()
    high = max(float(position[2]), float(at(clearance)()[2]))
    up = np.array([position[0], position[1], high])
    yield from hand.move(up, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=60, give_up=lost)

    yield from travel(hand, at(clearance), lambda: turn, CLOSED, target=support, held=held, give_up=lost)

    def over() -> Array:
        target = at(clearance)()
        return np.array([target[0], target[1], max(target[2], high - 0.02)])

    yield from hand.move(over, turn, CLOSED, tolerance=0.012, turn_tolerance=0.08, give_up=lost)
    yield from hand.move(at(clearance), turn, CLOSED, tolerance=0.012, timeout=60, give_up=lost)
    if lost():
        return False
    yield from hand.lower(at(0.0), turn, CLOSED, tolerance=tolerance)
    return holding(hand, held)


def _hand_over(hand: Hand, held: Held, destination: Target, turn: Array) -> Callable[[float], Target]:
    """Return, for a height over the destination, m, where the hand is when the held thing is there."""

    def at(height: float) -> Target:
        def target() -> Array:
            # Where the thing really is in the hand, not where it was when grasped: it may have turned or slipped.
            position, rotation = hand.sim.eef_pose()
            now, _ = hand.sim.body_pose(held.name)
            offset = turn @ rotation.T @ (now - position)
            return destination() - offset + height * UP

        return target

    return at


def _upright(hand: Hand, held: Held) -> Array:
    """Return the hand's rotation (3, 3) at which the held thing stands level, turned about the vertical as it is."""
    _, now = hand.sim.body_pose(held.name)
    tilt = cross(now[:, 2], UP)
    angle = float(np.arctan2(np.linalg.norm(tilt), now[2, 2]))
    if angle > MOST_RIGHTING:
        return hand.rotation
    return Rotation.from_rotvec(unit(tilt) * angle).as_matrix() @ hand.rotation


def put_on(hand: Hand, held: Held, support: str) -> Doing:
    """Set the held thing down on the middle of another object."""
    asset, below = hand.sim.assets[held.name], hand.sim.assets[support]
    # What is too long for a bowl's floor comes to rest on its wall, near the rim.
    height = below.supports if asset.radius <= below.clear_radius else below.top - 0.012
    turn = _upright(hand, held)

    def destination() -> Array:
        position, rotation = hand.sim.body_pose(support)
        _, tilt = hand.sim.body_pose(held.name)
        drop = -asset.bottom if tilt[2, 2] > 0.9 else asset.radius * 0.6
        return position + rotation @ np.array([0.0, 0.0, height]) + (drop + 0.008) * UP

    clearance = max(0.08, below.top - height + 0.06)
    arrived = yield from carry(hand, held, destination, turn, clearance, support=support)
    yield from release(hand)
    return arrived


def put_on_region(hand: Hand, held: Held, position: Array) -> Doing:
    """Set the held thing down with its origin over a place (3,) of a level surface."""
    asset = hand.sim.assets[held.name]
    turn = _upright(hand, held)
    arrived = yield from carry(
        hand, held, lambda: position + (0.006 - asset.bottom) * UP, turn, clearance=0.10, tolerance=0.008
    )
    yield from release(hand)
    return arrived


def put_at(hand: Hand, held: Held, position: Array, rotation: Array | None = None) -> Doing:
    """Set the held thing down with its origin at a place, turned as it was."""
    turn = hand.rotation if rotation is None else rotation @ held.turn.T
    arrived = yield from carry(hand, held, lambda: position + 0.004 * UP, turn, clearance=0.08)
    yield from release(hand)
    return arrived


def put_in_drawer(hand: Hand, held: Held, region: str, outward: Array) -> Doing:
    """Drop the held thing into an open drawer."""
    half = hand.sim.site_half_size(region)
    asset = hand.sim.assets[held.name]
    # Close along the front: the hand is 20 cm wide that way and would hit the cabinet the other way.
    turn = frame(DOWN, cross(UP, outward))

    def destination() -> Array:
        centre, _ = hand.sim.site_pose(region)
        return centre + 0.015 * outward + (half[2] - asset.bottom - 0.005) * UP - 0.02 * UP

    arrived = yield from carry(hand, held, destination, turn, clearance=0.12, tolerance=0.012)
    yield from release(hand)
    return arrived
