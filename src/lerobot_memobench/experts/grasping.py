"""Pick and place: choose a way to hold a thing, take it from above and lift it, bring it to where it belongs.

A hold that misses is tried another way.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.hand import (
    CLOSED,
    COMFORTABLE,
    DOWN,
    OPEN,
    STRETCHED,
    UP,
    Array,
    Hand,
    Steps,
    Target,
    cross,
    downward,
    frame,
    length,
    rotation_vector,
    unit,
)
from lerobot_memobench.experts.travel import (
    FINGER_REACH,
    FULLY_OPEN,
    Held,
    clear_of_objects,
    corners,
    crowding,
    drawer_around,
    holding,
    in_the_way,
    lean_from_fixtures,
    outward_of,
    reach_lean,
    region_box,
    release,
    rise,
    travel,
)
from lerobot_memobench.sim.assets.asset import Asset, Grasp
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP

ATTEMPTS = 4
"""How often a thing is reached for, a handle, door or knob moved, before it is given up."""
LOW_ATTEMPTS = 2
"""How many of them are made before a tall thing is held higher."""
OUT_OF_REACH = 0.04
"""By how much the arm may be too short for a low hold that is tried before the higher ones, m."""
HIGHER, BELOW_TOP = 0.02, 0.0122
"""By how much, and how much of it then still stands over the middle of the fingers, m."""
LYING = 0.7
"""Cosine of the tilt from which a thing lies on its side."""
MUCH_WORSE = 1.5
"""Cost by which a hold is behind the best one and not tried."""
FUNNEL, FUNNEL_MOUTH = 4.0, 0.006
"""Height kept per distance from the line over the target, and the distance from which on, m."""
TIGHT = 0.6
"""Share of the room between open fingers and a thing's side up to which the hand may be off when it comes down."""
STOPPED, NEAR = 6, 0.015
"""Steps without getting nearer after which the fingers close where they are, once they are so near, m: on a plate's
rim, say. A longer wait, in which nothing changes, is hard to learn."""
LIFT = 0.10
"""How high a thing is lifted before it is carried, m."""
HOVER = 0.09
"""Height over a grasp at which the hand turns and aligns, m."""
RIM_GAP, DEEP_GAP = 0.004, 0.012
"""Room left between a rim and the inner finger while the hand comes down, m: on a plate, at most in a deep bowl. Who
learns to see where the rim is needs room."""
STEEP = 0.7
"""How much of it there is for each metre that the finger then stands over the floor."""
CLOSING_LEAD = 0.03
"""How much narrower than they are the fingers are taken to be while they close: the arm is slower than they, m."""
ASTRAY = 0.025
"""Distance from its place in a drawer, m, from which a held thing is not let go: it would come to lean on a wall."""
TIPPED = 0.08
"""By how much less upright a bowl may be once it is grasped, as a cosine: it slips if its rim was pressed on."""
SUNK = 0.002
"""How deep a thing may lie in what it rests on, m."""
FAR_SIDE = 0.15
"""Cost of a rim's side across from the arm's foot. Two sides of a bowl are often as good, and who learns from both, not
seeing why one was taken, puts the hand into the middle."""
WIDE = 0.068
"""Width from which an object is hard to take, m."""
RIM_LEAN = np.radians(14)
"""How far the hand may lean with the wall of a bowl, rad."""
MOST_RIGHTING = np.radians(35)
"""Tilt of a held thing up to which it is set upright before it is set down, rad."""


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _is_rim(hand: Hand, name: str, grasp: Grasp) -> bool:
    return grasp.symmetric and hand.sim.assets[name].clear_radius > 0 and abs(grasp.position[0]) > 0.02


def grasp_pose(
    hand: Hand,
    name: str,
    grasp: Grasp,
    spin: float,
    opening: float | None = None,
    place: Array | None = None,
    reaching: bool = False,
) -> tuple[Array, Array]:
    """Return where the grip site goes to take ``name``, and how the hand is turned there.

    A rim is taken with the inner finger close to the wall, however wide the fingers stand: the hand comes in from
    outside and follows the outer finger as it closes. What lies in the bowl is not touched. The hand leans away from
    what stands beside the object, and towards the arm where the object or ``place``, where it will be brought, is far.
    Where one forbids the other it keeps clear, unless it is to be ``reaching``.
    """
    opening = hand.sim.gripper_opening() if opening is None else opening
    position, rotation = hand.sim.asset_pose(name)
    spun = rotation @ Rotation.from_rotvec([0.0, 0.0, spin]).as_matrix()
    target = position + spun @ np.asarray(grasp.position)
    rim = _is_rim(hand, name, grasp)
    outward = np.zeros(3)
    if rim:
        outward = spun[:, 0] * np.sign(grasp.position[0])
        over = grasp.position[2] - FINGER_REACH - hand.sim.assets[name].supports
        gap = float(np.clip(STEEP * over, RIM_GAP, DEEP_GAP))
        target = target + outward * max(0.0, opening / 2 - grasp.width / 2 - gap)
    closing = _yaw(rotation) + spin + grasp.yaw
    if rotation[2, 2] < LYING:
        target, rim = position.copy(), False
        closing = _closing_of_fallen(hand, name)
    target[2] = max(target[2], _ground(hand, name) + FINGER_REACH)
    turn = downward(closing)
    away = _lean(hand, name, target, turn[:, 0], place, outward if rim else None)
    return target, clear_of_objects(hand, name, target, turn[:, 0], away, reaching)


def _ground(hand: Hand, name: str) -> float:
    """Return the height, m, of what a thing rests on, which the fingers should not press: the table, a plate."""
    position, rotation = hand.sim.asset_pose(name)
    lowest = position[2] + (rotation @ corners(hand.sim.assets[name]))[2].min()
    return max(TABLE_TOP, float(lowest) - SUNK)


def _lean(hand: Hand, name: str, target: Array, closing: Array, place: Array | None, outward: Array | None) -> Array:
    """Return by how much and whither the hand leans at a grasp, (3,), rad; ``outward`` is where a rim's wall slopes."""
    lean = lean_from_fixtures(hand, name, target)
    # Only about the closing axis: the fingers stay level and the thin side of the hand turns away.
    away = lean - (lean @ closing) * closing
    reach = reach_lean(hand, target)
    if place is not None:
        position, _ = hand.sim.asset_pose(name)
        there = reach_lean(hand, place + target - position, STRETCHED)
        reach = max(reach, there, key=length)
    away = away + reach - (reach @ closing) * closing
    if outward is not None:
        # The wall of a bowl slopes: on the arm's side the fingers may lean with it.
        away = away + outward * float(np.clip(reach @ outward, 0.0, RIM_LEAN))
    return away


def _closing_of_fallen(hand: Hand, name: str) -> float:
    """Return the angle, rad, of the narrower of the two level sides of a thing that lies on its side.

    In a drawer it is that of the front: the other way the hand, 20 cm wide, would not fit in before the cabinet.
    """
    drawer = drawer_around(hand, name)
    if drawer is not None:
        out = outward_of(hand, hand.sim.world.articulation(drawer)[0])
        return float(np.arctan2(out[0], -out[1]))
    _, rotation = hand.sim.asset_pose(name)
    asset = hand.sim.assets[name]
    size = np.asarray(asset.high) - np.asarray(asset.low)
    upright = int(np.argmax(np.abs(rotation[2])))
    side = min((k for k in range(3) if k != upright), key=lambda k: float(size[k]))
    return float(np.arctan2(rotation[1, side], rotation[0, side]))


@dataclass(frozen=True)
class _Approach:
    """The way to one grasp of an object, asked anew at every step: the object may move."""

    hand: Hand
    name: str
    grasp: Grasp
    spin: float
    place: Array | None
    reaching: bool

    def pose(self, opening: float | None = None) -> tuple[Array, Array]:
        return grasp_pose(self.hand, self.name, self.grasp, self.spin, opening, self.place, self.reaching)

    def above(self) -> Array:
        """Over the grasp along the fingers, so that a leaning hand comes in as it will leave."""
        target, turn = self.pose()
        return target - HOVER * turn[:, 2]

    def at(self) -> Array:
        """At the grasp, reached as through a funnel: lower only where it is over the middle."""
        target, turn = self.pose()
        off = self.hand.position - target
        beside = length(off - (off @ turn[:, 2]) * turn[:, 2])
        room = (FULLY_OPEN - self.grasp.width) / 2
        mouth = min(FUNNEL_MOUTH, TIGHT * room)
        return target - min(HOVER, FUNNEL * max(0.0, beside - mouth)) * turn[:, 2]

    def turned(self) -> Array:
        return self.pose()[1]

    def stopped(self) -> Callable[[], bool]:
        """Return what tells, asked at every step, that the hand is about there and gets no nearer."""
        way: list[float] = []

        def asked() -> bool:
            way.append(self.hand.error(*self.pose())[0])
            return way[-1] < NEAR and len(way) > STOPPED and way[-1 - STOPPED] - way[-1] < 0.002

        return asked

    def closing(self) -> Array:
        """Where the hand goes while the fingers close."""
        return self.pose(max(self.hand.sim.gripper_opening() - CLOSING_LEAD, self.grasp.width))[0]


def _choose_grasp(hand: Hand, name: str, attempt: int, avoid: Array | None, place: Array | None) -> _Approach:
    """Pick one of an object's grasps, turned where that is free: easy for the wrist, clear of its neighbours."""
    asset = hand.sim.assets[name]
    if not asset.grasps:
        raise MemobenchError(
            f"the expert does not know how to hold {name!r}: class {asset.class_name} declares no grasp"
        )
    higher = _higher(asset)
    options = [] if attempt >= LOW_ATTEMPTS else _options(hand, name, asset.grasps, avoid, place, reaching=False)
    if not options or (higher and _short(options[0][1]) > OUT_OF_REACH):
        # What stands beside keeps the hand from leaning to where the arm can reach; over it there is room.
        options = _options(hand, name, higher or asset.grasps, avoid, place, reaching=True)
        attempt = max(0, attempt - LOW_ATTEMPTS) if higher else attempt
    options = [option for option in options if option[0] < options[0][0] + MUCH_WORSE]
    # A later attempt tries the next different way; each varies a little between episodes.
    rank = min(attempt * max(1, len(options) // 6), len(options) - 1)
    _, way = options[rank]
    return replace(way, spin=way.spin + float(hand.rng.uniform(-0.1, 0.1))) if way.grasp.symmetric else way


def _options(
    hand: Hand, name: str, grasps: Sequence[Grasp], avoid: Array | None, place: Array | None, *, reaching: bool
) -> list[tuple[float, _Approach]]:
    """Return the ways to some grasps with their costs, the cheapest first."""
    options: list[tuple[float, _Approach]] = []
    for grasp in grasps:
        for spin in np.arange(0.0, 2 * np.pi, np.pi / 12) if grasp.symmetric else [0.0]:
            way = _Approach(hand, name, grasp, float(spin), place, reaching)
            options.append((_cost(way, avoid), way))
    return sorted(options, key=lambda option: option[0])


def _short(way: _Approach) -> float:
    """Return by how much the arm is too short for a grasp, m."""
    return way.hand.stretch(*way.pose(FULLY_OPEN)) - STRETCHED


def _higher(asset: Asset) -> tuple[Grasp, ...]:
    """Return the grasps that can be had nearer to the top of a tall thing."""
    return tuple(
        replace(grasp, position=(*grasp.position[:2], grasp.position[2] + HIGHER))
        for grasp in asset.grasps
        if asset.top - grasp.position[2] >= HIGHER + BELOW_TOP
    )


def _cost(way: _Approach, avoid: Array | None) -> float:
    """Return how bad it is to hold an object so: far for wrist and arm, among neighbours, at a reach."""
    hand, name = way.hand, way.name
    here, start = hand.sim.eef_pose()
    target, turn = way.pose(FULLY_OPEN)
    wrist = length(rotation_vector(turn @ start.T))
    cost = 0.3 * wrist + length(target - here) + crowding(hand, name, target, turn)
    if avoid is not None:
        cost += 2.0 * abs(float(turn[:, 0] @ avoid))
    cost += 3.0 * abs(float(turn[:, 0] @ lean_from_fixtures(hand, name, target)))
    blocked = in_the_way(hand, name, target, turn)
    cost += (0.0 if way.reaching else 2.0) + 20.0 * blocked if blocked > 0.0 else 0.0
    cost += 0.3 if way.grasp.width > WIDE else 0.0
    position, _ = hand.sim.asset_pose(name)
    if _is_rim(hand, name, way.grasp):
        cost += FAR_SIDE * (1.0 + float(unit(target - position) @ hand.radial(position)))
    ends = [target] if way.place is None else [target, way.place + target - position]
    stretch = max(hand.stretch(end, turn) for end in ends)
    # Beyond `STRETCHED` the hand stays short of it and closes on an edge, which slips.
    return cost + 20.0 * max(0.0, stretch - COMFORTABLE) + 40.0 * max(0.0, stretch - STRETCHED)


def pick(
    hand: Hand, name: str, avoid: Array | None = None, place: Array | None = None
) -> Generator[NDArray[np.float32], None, Held | None]:
    """Take an object from above and lift it; try other grasps when one misses.

    Args:
        hand: the arm.
        name: the object.
        avoid: horizontal direction (3,) along which the fingers should not close, for the place it is brought to.
        place: where the object's origin will be brought, (3,), m: a far place wants another hold than a near one.

    Returns:
        How it is held, or None when every attempt missed.
    """
    failed = 0
    for attempt in range(ATTEMPTS):
        way = _choose_grasp(hand, name, failed, avoid, place)
        upright = hand.sim.asset_pose(name)[1][2, 2] if _is_rim(hand, name, way.grasp) else -1.0
        yield from rise(hand, OPEN)
        yield from travel(hand, way.above, way.turned, OPEN, target=name)
        yield from hand.move(way.above, way.turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
        yield from hand.move(way.at, way.turned, OPEN, tolerance=0.005, speed=0.6, timeout=60, give_up=way.stopped())
        yield from hand.close(way.closing, hand.rotation)
        # Fingers that met go back at once, the first time to the same place: what is learned of a miss is then not that
        # nothing is lifted first, nor that another way is tried for no reason that can be seen.
        failed += attempt > 0 or not hand.empty
        missed = hand.empty or hand.sim.asset_pose(name)[1][2, 2] < upright - TIPPED
        held = None if missed else (yield from _lift(hand, name))
        if held is not None:
            return held
        yield from hand.wait(4, OPEN)
    return None


def _lift(hand: Hand, name: str) -> Generator[NDArray[np.float32], None, Held | None]:
    """Lift what the fingers have closed on; return how it is held, None where it stayed behind."""
    start, _ = hand.sim.asset_pose(name)
    # Back along the fingers: straight up where the hand hangs down, away from what it leans away from.
    lifted = hand.position - LIFT * hand.rotation[:, 2]
    yield from hand.move(lifted, hand.rotation, CLOSED, tolerance=0.02, speed=0.7, timeout=60)
    now, turn = hand.sim.asset_pose(name)
    if hand.empty or now[2] - start[2] <= LIFT * 0.5:
        return None
    position, rotation = hand.sim.eef_pose()
    return Held(name, rotation.T @ (now - position), rotation.T @ turn)


# --- placing ---


def carry(
    hand: Hand,
    held: Held,
    destination: Target,
    turn: Array,
    clearance: float,
    tolerance: float = 0.006,
    support: str = "",
) -> Steps:
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
    if not lost():
        yield from hand.lower(at(0.0), turn, CLOSED, tolerance=tolerance)


def _hand_over(hand: Hand, held: Held, destination: Target, turn: Array) -> Callable[[float], Target]:
    """Return, for a height over the destination, m, where the hand is when the held thing is there."""

    def at(height: float) -> Target:
        def target() -> Array:
            # Where the thing really is in the hand, not where it was when grasped: it may have turned or slipped.
            position, rotation = hand.sim.eef_pose()
            now, _ = hand.sim.asset_pose(held.name)
            offset = turn @ rotation.T @ (now - position)
            return destination() - offset + height * UP

        return target

    return at


def _upright(hand: Hand, held: Held) -> Array:
    """Return the hand's rotation (3, 3) at which the held thing stands level, turned about the vertical as it is."""
    _, now = hand.sim.asset_pose(held.name)
    tilt = cross(now[:, 2], UP)
    angle = float(np.arctan2(np.linalg.norm(tilt), now[2, 2]))
    if angle > MOST_RIGHTING:
        return hand.rotation
    return Rotation.from_rotvec(unit(tilt) * angle).as_matrix() @ hand.rotation


def put_on(hand: Hand, held: Held, support: str) -> Steps:
    """Set the held thing down on the middle of another object."""
    asset, below = hand.sim.assets[held.name], hand.sim.assets[support]
    # What is too long for a bowl's floor comes to rest on its wall, near the rim.
    height = below.supports if asset.radius <= below.clear_radius else below.top - 0.012
    turn = _upright(hand, held)

    def destination() -> Array:
        position, rotation = hand.sim.asset_pose(support)
        _, tilt = hand.sim.asset_pose(held.name)
        drop = -asset.bottom if tilt[2, 2] > 0.9 else asset.radius * 0.6
        return position + rotation @ np.array([0.0, 0.0, height]) + (drop + 0.008) * UP

    clearance = max(0.08, below.top - height + 0.06)
    yield from carry(hand, held, destination, turn, clearance, support=support)
    yield from release(hand)


def put_on_region(hand: Hand, held: Held, position: Array) -> Steps:
    """Set the held thing down with its origin over a place (3,) of a level surface."""
    asset = hand.sim.assets[held.name]
    turn = _upright(hand, held)
    yield from carry(hand, held, lambda: position + (0.006 - asset.bottom) * UP, turn, clearance=0.10, tolerance=0.008)
    yield from release(hand)


def put_at(hand: Hand, held: Held, position: Array, rotation: Array) -> Steps:
    """Set the held thing down with its origin at a place, turned by a rotation (3, 3)."""
    yield from carry(hand, held, lambda: position + 0.004 * UP, rotation @ held.turn.T, clearance=0.08)
    yield from release(hand)


def put_in_drawer(hand: Hand, held: Held, region: str, outward: Array) -> Steps:
    """Drop the held thing into an open drawer."""
    height = region_box(hand, region)[2][2]
    asset = hand.sim.assets[held.name]
    # Close along the front: the hand is 20 cm wide that way and would hit the cabinet the other way.
    turn = frame(DOWN, cross(UP, outward))

    def destination() -> Array:
        centre, _ = hand.sim.site_pose(region)
        return centre + 0.015 * outward + (height - asset.bottom - 0.005) * UP - 0.02 * UP

    for _ in range(ATTEMPTS):
        yield from carry(hand, held, destination, turn, clearance=0.12, tolerance=0.012)
        if not holding(hand, held) or length(hand.sim.asset_pose(held.name)[0] - destination()) < ASTRAY:
            break
    yield from release(hand)
