"""Pull, swing and push hinged doors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.grasping import ATTEMPTS, HOVER
from lerobot_memobench.experts.hand import (
    CLOSED,
    DOWN,
    EASY_CLOSING,
    OPEN,
    STRETCHED,
    UP,
    Array,
    Hand,
    cross,
    frame,
    length,
    unit,
)
from lerobot_memobench.experts.leaning import far, leaning, reach_lean
from lerobot_memobench.experts.travel import LOST, Doing, Steps, let_go, pressed, rise
from lerobot_memobench.sim.assets.asset import Articulation

REACH = 0.72
"""Distance from the arm's foot up to which a hand that points down moves freely, m."""
DOOR_THICKNESS = 0.02
EDGE_INSET, EDGE_DEPTH = 0.012, 0.018
"""Where a door's upper edge is taken: so far from the handle towards the hinge and so deep, m."""
SWING_LEAD = 0.13
"""Angle by which the hand leads a door along its arc, rad."""
EASE = 0.04
"""The same where the door is as far open as it should be, rad: a hand that arrives fast throws the door on, out of
reach."""
PUSH_GAP = 0.06
"""Distance in front of a handle from which the closed fingers come to push it, m."""


@dataclass(frozen=True)
class Door:
    """Where a hinged door stands now. Directions are level unit vectors (3,), places are (3,), m."""

    q: float
    hinge: Array
    handle: Array
    outward: Array
    """Out of the door's front."""
    along: Array
    """From the hinge to the free edge."""
    edge: Array
    """A place on the upper edge, half way into the panel, near the handle."""


def door_now(hand: Hand, name: str, ahead: float = 0.0) -> Door:
    """Return a door's geometry, turned ``ahead`` by an angle of its joint, rad."""
    articulation, q = hand.sim.world.articulation(name)
    joint = hand.sim.data.joint(articulation.joint)
    hinge = joint.xanchor.copy()
    handle, frame_ = hand.sim.site_pose(articulation.handle_site)
    lever = handle - hinge
    opening = cross(joint.xaxis, lever) * np.sign(articulation.open_q - articulation.closed_q)
    outward = unit(frame_[:, 1] * np.array([1.0, 1.0, 0.0]))
    outward = outward if outward @ opening > 0 else -outward
    along = cross(UP, outward)
    along = along if along @ lever > 0 else -along
    edge = _edge(hand, name, handle, outward, along)
    turn = Rotation.from_rotvec(joint.xaxis * ahead)
    return Door(
        q + ahead,
        hinge,
        hinge + turn.apply(lever),
        turn.apply(outward),
        turn.apply(along),
        hinge + turn.apply(edge - hinge),
    )


def _edge(hand: Hand, name: str, handle: Array, outward: Array, along: Array) -> Array:
    """Return where a door's upper edge is taken, (3,), m."""
    articulation, _ = hand.sim.world.articulation(name)
    owner = _owner(hand, name)
    depth = articulation.handle.clearance + articulation.handle.thickness[0] / 2 + DOOR_THICKNESS / 2
    edge = handle - depth * outward - EDGE_INSET * along
    edge[2] = hand.sim.body_pose(owner)[0][2] + hand.sim.assets[owner].top
    return edge


def _owner(hand: Hand, name: str) -> str:
    """Return the fixture that an articulation's name (``microwave_1``, ``cabinet_1_top_region``) belongs to."""
    return max((other for other in hand.sim.assets if name == other or name.startswith(f"{other}_")), key=len)


def wanted(q: float, articulation: Articulation, opening: bool) -> bool:
    """Return whether a door is open, or closed, with a little to spare."""
    assert articulation.open_below is not None
    assert articulation.closed_above is not None
    return q < articulation.open_below - 0.015 if opening else q > articulation.closed_above + 0.002


def open_door(hand: Hand, name: str) -> Doing:
    """Pull a door by its handle as far as the arm comfortably reaches, then swing it on by its upper edge."""
    articulation, _ = hand.sim.world.articulation(name)
    assert articulation.open_below is not None
    for _ in range(ATTEMPTS):
        if far(door_now(hand, name).handle) < REACH:
            yield from _pull_door(hand, name)
        if hand.sim.world.articulation(name)[1] >= articulation.open_below:
            yield from _swing_door(hand, name, opening=True)
        if hand.sim.world.articulation(name)[1] < articulation.open_below:
            return True
    return False


def close_door(hand: Hand, name: str) -> Doing:
    """Swing a door by its upper edge until its handle is in reach, then push it shut there."""
    articulation, _ = hand.sim.world.articulation(name)
    assert articulation.closed_above is not None
    for _ in range(ATTEMPTS):
        door = door_now(hand, name)
        if far(door.handle + PUSH_GAP * door.outward) > REACH:
            yield from _swing_door(hand, name, opening=False)
        yield from _push_door(hand, name)
        if hand.sim.world.articulation(name)[1] > articulation.closed_above:
            return True
    return False


def _pull_door(hand: Hand, name: str) -> Steps:
    """Take the upper end of an upright handle between the fingers and follow the door's arc."""
    articulation, _ = hand.sim.world.articulation(name)
    up = (articulation.handle.length / 2 - 0.018) * UP
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def at(height: float, ahead: float = 0.0) -> Callable[[], Array]:
        return lambda: door_now(hand, name, ahead).handle + up + height * UP

    def turned(ahead: float = 0.0) -> Array:
        return frame(DOWN, flip * door_now(hand, name, ahead).along)

    yield from rise(hand, OPEN, 0.26)
    yield from hand.move(at(HOVER + 0.02), turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()
    way = np.sign(articulation.open_q - articulation.closed_q)
    for _ in range(160):
        door = door_now(hand, name)
        if wanted(door.q, articulation, True) or far(door.handle) > REACH:
            break
        if hand.empty or length(hand.position - door.handle - up) > LOST:
            break
        yield hand.toward(at(0.0, way * SWING_LEAD)(), turned(way * SWING_LEAD / 2), CLOSED, speed=0.8)
    yield from let_go(hand)


def _swing_door(hand: Hand, name: str, opening: bool) -> Steps:
    """Take a door that stands ajar by its upper edge and follow its arc."""
    articulation, start = hand.sim.world.articulation(name)
    goal = articulation.open_below if opening else articulation.closed_q
    assert goal is not None
    way = float(np.sign(goal - start))
    flip = np.sign(door_now(hand, name, (goal - start) / 2).outward @ EASY_CLOSING) or 1.0

    def turned(ahead: float = 0.0) -> Array:
        # A door that stands wide open is taken with the fingers pointing outwards: upright, the hand is too short.
        door = door_now(hand, name, ahead)
        return leaning(flip * door.outward, reach_lean(hand, door.edge, STRETCHED))

    def at(back: float, ahead: float = 0.0) -> Callable[[], Array]:
        return lambda: door_now(hand, name, ahead).edge - back * turned(ahead)[:, 2]

    yield from rise(hand, OPEN, 0.26)
    yield from hand.move(at(HOVER), turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
    yield from hand.move(at(-EDGE_DEPTH), turned, OPEN, tolerance=0.006, speed=0.6, timeout=60)
    yield from hand.close()
    for _ in range(160):
        door = door_now(hand, name)
        if _swung(hand, door, articulation, opening):
            break
        lead = way * min(SWING_LEAD, abs(goal - door.q) + EASE)
        yield hand.toward(at(-EDGE_DEPTH, lead)(), turned(lead / 2), CLOSED, speed=0.8)
    yield from let_go(hand)


def _swung(hand: Hand, door: Door, articulation: Articulation, opening: bool) -> bool:
    """Return whether swinging ends: the door is where it should be, can be pushed shut, or has slipped away."""
    if wanted(door.q, articulation, opening):
        return True
    if not opening and far(door.handle + PUSH_GAP * door.outward) < REACH - 0.04:
        return True
    return hand.empty or length(hand.position - door.edge) > LOST + EDGE_DEPTH


def _push_door(hand: Hand, name: str) -> Steps:
    """Push a door shut with closed fingers on the outside of its handle."""
    articulation, _ = hand.sim.world.articulation(name)
    way = float(np.sign(articulation.closed_q - articulation.open_q))
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def at(gap: float, height: float = 0.0, ahead: float = 0.0) -> Array:
        door = door_now(hand, name, ahead)
        return door.handle + gap * door.outward + height * UP

    def turned(ahead: float = 0.0) -> Array:
        return frame(DOWN, flip * door_now(hand, name, ahead).along)

    yield from rise(hand, CLOSED, 0.26)
    yield from hand.move(lambda: at(PUSH_GAP, 0.15), turned, CLOSED, tolerance=0.02, turn_tolerance=0.1)
    yield from hand.move(lambda: at(PUSH_GAP), turned, CLOSED, tolerance=0.012, turn_tolerance=0.1)
    shut = pressed(lambda: wanted(hand.sim.world.articulation(name)[1], articulation, False))
    for _ in range(160):
        if shut():
            break
        door = door_now(hand, name)
        if abs(float((hand.position - door.handle) @ door.along)) > 0.04:
            break
        yield hand.toward(at(0.01, 0.0, way * SWING_LEAD), turned(), CLOSED, speed=0.8)
    back = hand.position + 0.06 * door_now(hand, name).outward
    yield from hand.move(back, hand.rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=40)
    yield from rise(hand, CLOSED, 0.26)
