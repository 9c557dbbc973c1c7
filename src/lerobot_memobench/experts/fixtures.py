"""Fixtures: pull and push drawers by their handles, turn knobs, open and shut hinged doors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

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
    Steps,
    cross,
    downward,
    frame,
    length,
    rotation_vector,
    unit,
)
from lerobot_memobench.experts.travel import (
    FULLY_OPEN,
    LOST,
    far,
    leaning,
    let_go,
    outward_of,
    pressed,
    reach_lean,
    rise,
)
from lerobot_memobench.sim.assets.asset import Articulation

TILT = np.radians(35)
"""How far the hand points down when it takes a handle: enough for the flange to clear the table."""
SKEW, SKEW_TILT = np.radians(40), np.radians(24)
"""How far the hand is rolled to take a bar that is longer than its fingers open, one above and one below it, and how
far it then points down: upright or steeper it would touch the table under the lowest drawer, or the handle above."""

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
FREE_EASE = 0.015
"""The same for a door that nothing but damping stops, rad."""
PUSH_GAP = 0.06
"""Distance in front of a handle from which the closed fingers come to push it, m."""

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


# --- drawers and knobs ---


def _at_handle(hand: Hand, articulation: Articulation, tilt: float) -> tuple[Array, Array, Array]:
    """Return a handle's position, the direction back along the fingers, and the hand's rotation to hold it.

    The fingers close level, along the front: the hand is 20 cm wide that way and thin the other, so that it neither
    touches the table under the lowest drawer nor the handle above.
    """
    position, _ = hand.sim.site_pose(articulation.handle_site)
    out = outward_of(hand, articulation)
    back = np.cos(tilt) * out + np.sin(tilt) * UP
    return position, back, frame(-back, cross(UP, out))


def _off_handle(hand: Hand, articulation: Articulation, tilt: float, back: float) -> Callable[[], Array]:
    """Return where the hand is when it stands ``back`` from a handle along its fingers, m, asked anew each time."""

    def target() -> Array:
        position, direction, _ = _at_handle(hand, articulation, tilt)
        return position + back * direction

    return target


def _grip_of(hand: Hand, articulation: Articulation, tilt: float) -> Array:
    """Return the rotation (3, 3) of a hand that holds a handle: along the front, or askew where that is too long."""
    _, back, rotation = _at_handle(hand, articulation, tilt)
    if articulation.handle.length < FULLY_OPEN:
        return rotation
    return Rotation.from_rotvec(SKEW * back).as_matrix() @ rotation


def open_drawer(hand: Hand, region: str) -> Steps:
    """Take a drawer's handle and pull until the drawer counts as open."""
    articulation, _ = hand.sim.world.articulation(region)
    steep = TILT if articulation.handle.length < FULLY_OPEN else SKEW_TILT
    tilt = steep + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)
        yield from _take_handle(hand, articulation, tilt)
        rotation = _grip_of(hand, articulation, tilt)
        yield from _pull_drawer(hand, region, rotation, out)
        yield from hand.open(6)
        back = _off_handle(hand, articulation, tilt, 0.09)
        yield from hand.move(back, rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        if hand.sim.world.articulation(region)[1] < articulation.open_below:
            return


def _take_handle(hand: Hand, articulation: Articulation, tilt: float) -> Steps:
    at = partial(_off_handle, hand, articulation, tilt)

    def turned() -> Array:
        return _grip_of(hand, articulation, tilt)

    yield from rise(hand, OPEN, 0.16)
    yield from hand.move(at(0.14), turned, OPEN, tolerance=0.03, turn_tolerance=0.15)
    yield from hand.move(at(0.07), turned, OPEN, tolerance=0.012, turn_tolerance=0.06)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()


def _pull_drawer(hand: Hand, region: str, rotation: Array, out: Array) -> Steps:
    """Pull a drawer by its handle until it is open, or the handle is lost."""
    for _ in range(90):
        articulation, q = hand.sim.world.articulation(region)
        if q < articulation.open_below - 0.006:
            break
        handle, _ = hand.sim.site_pose(articulation.handle_site)
        if hand.empty or length(hand.position - handle) > LOST:
            break
        yield hand.toward(handle + 0.035 * out, rotation, CLOSED, speed=0.8)


def close_drawer(hand: Hand, region: str) -> Steps:
    """Push an open drawer shut with closed fingers on its handle."""
    articulation, _ = hand.sim.world.articulation(region)
    tilt = TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)
        rotation = _at_handle(hand, articulation, tilt)[2]
        yield from _come_before(hand, articulation, rotation, out)
        yield from _push_drawer(hand, region, rotation, out)
        back = hand.position + 0.08 * out
        yield from hand.move(back, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        if hand.sim.world.articulation(region)[1] > articulation.closed_above:
            return


def _come_before(hand: Hand, articulation: Articulation, rotation: Array, out: Array) -> Steps:
    """Bring the closed fingers in front of a handle, from above."""

    def before(gap: float) -> Array:
        return hand.sim.site_pose(articulation.handle_site)[0] + gap * out

    yield from rise(hand, CLOSED, 0.2)
    high = before(0.10) + 0.06 * UP
    yield from hand.move(high, rotation, CLOSED, tolerance=0.03, turn_tolerance=0.15)
    yield from hand.move(lambda: before(0.06), rotation, CLOSED, tolerance=0.015, turn_tolerance=0.08)


def _push_drawer(hand: Hand, region: str, rotation: Array, out: Array) -> Steps:
    """Push a drawer by its handle until it is shut, or the fingers slip off sideways."""
    articulation, _ = hand.sim.world.articulation(region)
    spare = min(0.003, articulation.closed_q - articulation.closed_above)
    shut = pressed(lambda: hand.sim.world.articulation(region)[1] > articulation.closed_above + spare)
    for _ in range(110):
        if shut():
            break
        handle, _ = hand.sim.site_pose(articulation.handle_site)
        gap = hand.position - handle
        if length(gap - (gap @ out) * out) > 0.04:
            break
        yield hand.toward(handle - 0.03 * out, rotation, CLOSED, speed=0.7)


def turn_knob(hand: Hand, name: str, on: bool) -> Steps:
    """Take a knob's ridge from above and turn it until it counts as on, or as off."""
    articulation, _ = hand.sim.world.articulation(name)
    on_from, off_to = articulation.on_at_least, articulation.off_below
    aim = on_from + float(hand.rng.uniform(0.12, 0.25)) if on else off_to - 0.15

    def reached(spare: float) -> bool:
        _, q = hand.sim.world.articulation(name)
        return q >= on_from + spare if on else q < off_to - min(spare, 1e-4)

    for _ in range(ATTEMPTS):
        yield from _take_ridge(hand, articulation)
        turned = partial(reached, 0.08)
        yield from _twist(hand, name, aim, turned if on else pressed(turned))
        yield from let_go(hand, 0.10)
        if reached(0.0):
            return


def _ridge(hand: Hand, articulation: Articulation) -> tuple[Array, Array]:
    """Return the position of a knob's ridge, (3,), and the rotation (3, 3) of a hand that takes it from above."""
    position, rotation = hand.sim.site_pose(articulation.handle_site)
    across = rotation[:, 1] * np.array([1.0, 1.0, 0.0])
    return position, downward(float(np.arctan2(across[1], across[0])))


def _take_ridge(hand: Hand, articulation: Articulation) -> Steps:
    def at(height: float) -> Callable[[], Array]:
        return lambda: _ridge(hand, articulation)[0] + height * UP

    def turned() -> Array:
        return _ridge(hand, articulation)[1]

    yield from rise(hand, OPEN)
    yield from hand.move(at(HOVER), turned, OPEN, tolerance=0.01, turn_tolerance=0.06)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()


def _twist(hand: Hand, name: str, aim: float, reached: Callable[[], bool]) -> Steps:
    """Turn the hand with a knob in it, to the knob's position ``aim``, rad."""
    grip = hand.rotation
    articulation, start = hand.sim.world.articulation(name)
    for _ in range(100):
        if reached() or hand.empty:
            break
        angle = float(rotation_vector(hand.rotation @ grip.T)[2])
        lead = float(np.clip(aim - start - angle, -0.25, 0.25)) + angle
        goal = Rotation.from_rotvec([0.0, 0.0, lead]).as_matrix() @ grip
        yield hand.toward(_ridge(hand, articulation)[0], goal, CLOSED)


# --- doors ---


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
    edge[2] = hand.sim.asset_pose(owner)[0][2] + hand.sim.assets[owner].top
    return edge


def _owner(hand: Hand, name: str) -> str:
    """Return the fixture that an articulation's name (``microwave_1``, ``cabinet_1_top_region``) belongs to."""
    return max((other for other in hand.sim.assets if name == other or name.startswith(f"{other}_")), key=len)


def wanted(q: float, articulation: Articulation, opening: bool) -> bool:
    """Return whether a door is open, or closed, with a little to spare."""
    return q < articulation.open_below - 0.015 if opening else q > articulation.closed_above + 0.002


def open_door(hand: Hand, name: str) -> Steps:
    """Pull a door by its handle as far as the arm comfortably reaches, then swing it on by its upper edge."""
    articulation, _ = hand.sim.world.articulation(name)
    for _ in range(ATTEMPTS):
        if far(door_now(hand, name).handle) < REACH:
            yield from _pull_door(hand, name)
        if hand.sim.world.articulation(name)[1] >= articulation.open_below:
            yield from _swing_door(hand, name, opening=True)
        if hand.sim.world.articulation(name)[1] < articulation.open_below:
            return


def close_door(hand: Hand, name: str) -> Steps:
    """Swing a door by its upper edge until its handle is in reach, then push it shut there."""
    articulation, _ = hand.sim.world.articulation(name)
    for _ in range(ATTEMPTS):
        door = door_now(hand, name)
        if far(door.handle + PUSH_GAP * door.outward) > REACH:
            yield from _swing_door(hand, name, opening=False)
        yield from _push_door(hand, name)
        if hand.sim.world.articulation(name)[1] > articulation.closed_above:
            return


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
    way = float(np.sign(goal - start))
    free = hand.sim.model.joint(articulation.joint).frictionloss[0] == 0.0
    ease, over = (FREE_EASE, HOVER) if free else (EASE, 0.0)  # a free door stands wider open: lean on the way down, too
    flip = np.sign(door_now(hand, name, (goal - start) / 2).outward @ EASY_CLOSING) or 1.0

    def turned(ahead: float = 0.0) -> Array:
        # A door that stands wide open is taken with the fingers pointing outwards: upright, the hand is too short.
        door = door_now(hand, name, ahead)
        return leaning(flip * door.outward, reach_lean(hand, door.edge + over * UP, STRETCHED))

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
        lead = way * min(SWING_LEAD, abs(goal - door.q) + ease)
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


# --- doors in one pull or push: half the steps of `open_door` and `close_door`, for rounds that are counted. The hand
# leans out as far as the door goes, where that of the published demonstrations lets go and takes it anew ---


def pull_open(hand: Hand, name: str) -> Steps:
    """Take a door's handle and follow the arc until the door counts as open."""
    for _ in range(ATTEMPTS):
        yield from _sweep_open(hand, name)
        yield from let_go(hand, 0.08)
        articulation, q = hand.sim.world.articulation(name)
        if wanted(q, articulation, True):
            return


def push_shut(hand: Hand, name: str) -> Steps:
    """Push a door's panel from outside until it is shut."""
    for _ in range(ATTEMPTS):
        yield from _sweep_shut(hand, name)
        articulation, q = hand.sim.world.articulation(name)
        if wanted(q, articulation, False):
            return


def _turned(hand: Hand, door: Door, place: Array, flip: float) -> Array:
    """Return the rotation (3, 3) of a hand that closes along the door and leans as far as a place needs."""
    closing = flip * door.along
    lean = reach_lean(hand, place)
    return leaning(closing, lean - (lean @ closing) * closing)


def _sweep_open(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    up = (articulation.handle.length / 2 - GRIP_BELOW) * UP
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def grip(ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_now(hand, name, ahead)
        return door.handle + up, _turned(hand, door, door.handle + up, flip)

    def over() -> Array:
        return grip()[0] - HOVER * grip()[1][:, 2]

    yield from hand.move(over, lambda: grip()[1], OPEN, tolerance=0.02, turn_tolerance=0.1)
    yield from hand.move(lambda: grip()[0], lambda: grip()[1], OPEN, tolerance=0.006, speed=0.8, timeout=60)
    yield from hand.close()
    way = np.sign(articulation.open_q - articulation.closed_q)
    for _ in range(STEPS):
        if wanted(door_now(hand, name).q, articulation, True) or length(hand.position - grip()[0]) > LOST:
            break
        yield hand.toward(*grip(way * LEAD), CLOSED)


def _sweep_shut(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    way = float(np.sign(articulation.closed_q - articulation.open_q))
    flip = np.sign(door_now(hand, name).along @ EASY_CLOSING) or 1.0

    def pose(gap: float, height: float = 0.0, ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_now(hand, name, ahead)
        place = door.edge - PUSH_IN * door.along + gap * door.outward + (height - PUSH_BELOW) * UP
        return place, _turned(hand, door, place, flip)

    yield from rise(hand, CLOSED, 0.26)
    for height, tolerance in ((0.12, 0.03), (0.0, 0.02)):
        target, turn = pose(BEFORE, height)
        yield from hand.move(target, turn, CLOSED, tolerance=tolerance, turn_tolerance=0.15)
    shut = pressed(lambda: wanted(hand.sim.world.articulation(name)[1], articulation, False))
    for _ in range(STEPS):
        if shut() or length(hand.position - pose(TOUCHING)[0]) > LOST + BEFORE:
            break
        yield hand.toward(*pose(TOUCHING, 0.0, way * LEAD), CLOSED)
    back = hand.position + 0.05 * door_now(hand, name).outward
    yield from hand.move(back, hand.rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=40)
