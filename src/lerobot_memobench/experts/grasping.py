"""Pick and place: choose a grasp, grasp and lift an object from above, and place it.

Failed grasps are retried with other candidates.
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
    COMFORTABLE_STRETCH,
    DOWN,
    MAX_STRETCH,
    OPEN,
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
    HAND_MARGIN,
    MAX_LEAN,
    MAX_LEAN_UNDER,
    OPEN_WIDTH,
    Held,
    clear_of_objects,
    corners,
    drawer_containing,
    finger_obstruction_cost,
    hand_penetration,
    is_held,
    lean_from_fixtures,
    opening_direction,
    reach_lean,
    region_box,
    release_object,
    rise,
    travel,
)
from lerobot_memobench.sim.asset import TABLE_TOP, Asset, Grasp

MAX_ATTEMPTS = 4  # maximum attempts at grasping an object or moving a handle, door or knob
LOW_GRASP_ATTEMPTS = 2  # attempts before a tall object is grasped higher
MAX_REACH_SHORTFALL = 0.04  # largest shortfall of the arm's reach for which a low grasp is tried before higher ones, m
RAISED_GRASP_OFFSET, MIN_DEPTH_BELOW_TOP = 0.02, 0.0122
"""Height offset of raised grasps, and smallest depth of the finger centre below the object's top, m."""
FALLEN_COSINE = 0.7  # cosine of the tilt below which an object lies on its side
MAX_EXTRA_COST = 1.5  # largest cost above the best grasp's of a candidate
SHIFTED_COST = 1.6
"""Cost of a shifted grasp, m; above `MAX_EXTRA_COST`, so that it is chosen only where the others are blocked."""
FINGER_HALF_WIDTH, MIN_SIDE_GAP = 0.0105, 0.006
"""Half the width of a finger tip, and smallest gap between a box and the near finger at a shifted grasp, m."""
FUNNEL_SLOPE, FUNNEL_RADIUS = 4.0, 0.006
"""Approach funnel: height per lateral distance beyond the radius, and the radius, m."""
FUNNEL_CLEARANCE_SHARE = 0.6  # share of the clearance between open fingers and object that limits the funnel's radius
GRASP_STALL_STEPS, GRASP_STALL_DISTANCE = 6, 0.015
"""Steps without progress after which the fingers close in place, and the largest distance to the grasp, m, for example
on a plate's rim. Policies hardly learn a longer wait without visible change."""
LIFT_HEIGHT = 0.10  # height to which an object is lifted before transport, m
HOVER_HEIGHT = 0.09  # height above a grasp for aligning the hand, m
MIN_RIM_GAP, MAX_RIM_GAP = 0.004, 0.012
"""Smallest (plate) and largest (deep bowl) gap between a rim and the inner finger during descent, m. Policies need the
gap because they localise the rim less exactly."""
RIM_GAP_SLOPE = 0.7  # gap per height of the finger above the container's floor
CLOSING_LEAD = 0.03
"""Reduction of the present opening for targets while closing, because the arm lags behind the fingers, m."""
MAX_RELEASE_OFFSET, LEVEL_COSINE = 0.03, 0.95
"""Largest horizontal distance from the target at which an object is released, m, and smallest upright cosine of its
support."""
MAX_DRAWER_OFFSET = 0.025
"""Largest distance from the target in a drawer at which an object is released, m; farther away it would lean on a
wall."""
MAX_TIPPING = 0.08  # largest decrease of a bowl's upright cosine by grasping; a bowl pressed on its rim slips
MAX_SINKING = 0.002  # depth by which an object may sink into its support, m
FAR_SIDE_COST = 0.15
"""Cost of the rim's side opposite to the arm's base. Two sides are often equally good; policies trained on both average
them and move to the middle."""
WIDE_GRASP = 0.068  # width from which a grasp is difficult, m
TIGHT_GRASP, TIGHT_GRASP_SPEED, TIGHT_COST = 0.074, 0.3, 1.5
"""Width from which a grasp leaves little room and the hand descends slowly, m; its speed, and cost in strict tasks."""
MAX_RIM_LEAN = np.radians(14)  # largest lean along a bowl's wall, rad
MAX_RIGHTING_TILT = np.radians(35)  # largest tilt of a held object that is corrected before placing, rad


def _is_rim(hand: Hand, name: str, grasp: Grasp) -> bool:
    return grasp.symmetric and hand.sim.assets[name].clear_radius > 0 and abs(grasp.position[0]) > 0.02


def _closing_of_fallen(hand: Hand, name: str) -> float:
    """Return the closing angle for an object that lies on its side: across its narrower horizontal extent, rad."""
    drawer = drawer_containing(hand, name)
    if drawer is not None:  # along the front: across it the hand, 20 cm wide, would collide with the cabinet
        out = opening_direction(hand, hand.sim.world.articulation(drawer)[0])
        return float(np.arctan2(out[0], -out[1]))
    _, rotation = hand.sim.asset_pose(name)
    asset = hand.sim.assets[name]
    size = np.asarray(asset.high) - np.asarray(asset.low)
    upright = int(np.argmax(np.abs(rotation[2])))
    side = min((k for k in range(3) if k != upright), key=lambda k: float(size[k]))
    return float(np.arctan2(rotation[1, side], rotation[0, side]))


@dataclass(frozen=True)
class _Approach:
    """Approach to one grasp of an object; targets follow the object's present pose."""

    hand: Hand
    name: str
    grasp: Grasp
    spin: float
    place: Array | None  # destination of the object's origin (3,), m
    reaching: bool  # whether reaching has priority over avoiding obstacles
    shifted: bool  # whether the grasp is one of `_shifted_grasps`, at which the hand may lean further

    def pose(self, opening: float | None = None) -> tuple[Array, Array]:
        """Return position (3,) and rotation (3, 3) of the grip site at an opening of the fingers; default: the present.

        The hand leans away from obstacles, and towards the base if the object or its destination is distant.
        """
        hand, name, grasp = self.hand, self.name, self.grasp
        opening = hand.sim.gripper_opening() if opening is None else opening
        position, rotation = hand.sim.asset_pose(name)
        spun = rotation @ Rotation.from_rotvec([0.0, 0.0, self.spin]).as_matrix()
        target = position + spun @ np.asarray(grasp.position)
        outward = None
        if _is_rim(hand, name, grasp):
            # The inner finger is close to the wall at every opening: the hand approaches from outside and follows the
            # outer finger while closing, so the bowl's content is not touched.
            outward = spun[:, 0] * np.sign(grasp.position[0])
            over = grasp.position[2] - FINGER_REACH - hand.sim.assets[name].supports
            gap = float(np.clip(RIM_GAP_SLOPE * over, MIN_RIM_GAP, MAX_RIM_GAP))
            target = target + outward * max(0.0, opening / 2 - grasp.width / 2 - gap)
        closing = float(np.arctan2(rotation[1, 0], rotation[0, 0])) + self.spin + grasp.yaw
        if rotation[2, 2] < FALLEN_COSINE:
            target, outward = position.copy(), None
            closing = _closing_of_fallen(hand, name)
        # The fingers must not press the object's support, such as table or plate.
        lowest = position[2] + (rotation @ corners(hand.sim.assets[name]))[2].min()
        target[2] = max(target[2], max(TABLE_TOP, float(lowest) - MAX_SINKING) + FINGER_REACH)
        turn = downward(closing)
        away = self._lean(target, turn[:, 0], outward)
        largest = MAX_LEAN_UNDER if self.shifted else MAX_LEAN
        return target, clear_of_objects(hand, name, target, turn[:, 0], away, self.reaching, largest)

    def _lean(self, target: Array, closing: Array, outward: Array | None) -> Array:
        """Return the lean (3,) at a grasp: direction times angle, rad; ``outward``: slope direction of a rim's wall."""
        lean = lean_from_fixtures(self.hand, self.name, target)
        # Lean about the closing axis only: the fingers stay level and the thin side of the hand turns away.
        away = lean - (lean @ closing) * closing
        reach = reach_lean(self.hand, target)
        if self.place is not None:
            position, _ = self.hand.sim.asset_pose(self.name)
            reach_at_destination = reach_lean(self.hand, self.place + target - position, MAX_STRETCH)
            reach = max(reach, reach_at_destination, key=length)
        away = away + reach - (reach @ closing) * closing
        if outward is not None:
            # On the base's side the fingers may lean along the bowl's sloping wall.
            away = away + outward * float(np.clip(reach @ outward, 0.0, MAX_RIM_LEAN))
        return away

    def above(self) -> Array:
        target, turn = self.pose()
        return target - HOVER_HEIGHT * turn[:, 2]

    def at(self) -> Array:
        """Return the grasp position (3,), m, raised along a funnel while the hand is laterally off."""
        target, turn = self.pose()
        offset = self.hand.position - target
        lateral = length(offset - (offset @ turn[:, 2]) * turn[:, 2])
        clearance = (OPEN_WIDTH - self.grasp.width) / 2
        radius = min(FUNNEL_RADIUS, FUNNEL_CLEARANCE_SHARE * clearance)
        return target - min(HOVER_HEIGHT, FUNNEL_SLOPE * max(0.0, lateral - radius)) * turn[:, 2]

    def turned(self) -> Array:
        return self.pose()[1]

    def stall_check(self) -> Callable[[], bool]:
        """Return a condition, evaluated once per step: the hand is near the grasp and makes no progress."""
        errors: list[float] = []

        def stalled() -> bool:
            errors.append(self.hand.error(*self.pose())[0])
            if errors[-1] >= GRASP_STALL_DISTANCE or len(errors) <= GRASP_STALL_STEPS:
                return False
            return errors[-1 - GRASP_STALL_STEPS] - errors[-1] < 0.002

        return stalled

    def closing(self) -> Array:
        return self.pose(max(self.hand.sim.gripper_opening() - CLOSING_LEAD, self.grasp.width))[0]


def _choose_grasp(hand: Hand, name: str, attempt: int, avoid: Array | None, place: Array | None) -> _Approach:
    asset = hand.sim.assets[name]
    if not asset.grasps:
        raise MemobenchError(
            f"the expert cannot hold {name!r}: class {asset.class_name} has no two opposite sides that fit the hand"
        )
    higher = _raised_grasps(asset)
    options = [] if attempt >= LOW_GRASP_ATTEMPTS else _options(hand, name, asset.grasps, avoid, place, reaching=False)
    if not options or (higher and hand.stretch(*options[0][1].pose(OPEN_WIDTH)) - MAX_STRETCH > MAX_REACH_SHORTFALL):
        # Neighbours prevent the lean needed for reaching; above them there is room.
        options = _options(hand, name, higher or asset.grasps, avoid, place, reaching=True)
        attempt = max(0, attempt - LOW_GRASP_ATTEMPTS) if higher else attempt
    options = [option for option in options if option[0] < options[0][0] + MAX_EXTRA_COST]
    # Later attempts take the next distinct candidate, with a small random variation.
    rank = min(attempt * max(1, len(options) // 6), len(options) - 1)
    approach = options[rank][1]
    if approach.grasp.symmetric:
        approach = replace(approach, spin=approach.spin + float(hand.rng.uniform(-0.1, 0.1)))
    return approach


def _options(
    hand: Hand, name: str, grasps: Sequence[Grasp], avoid: Array | None, place: Array | None, *, reaching: bool
) -> list[tuple[float, _Approach]]:
    options: list[tuple[float, _Approach]] = []
    shifted = _shifted_grasps(hand.sim.assets[name]) if hand.strict else ()
    for grasp in (*grasps, *shifted):
        for spin in np.arange(0.0, 2 * np.pi, np.pi / 12) if grasp.symmetric else [0.0]:
            approach = _Approach(hand, name, grasp, float(spin), place, reaching, grasp in shifted)
            options.append((_cost(approach, avoid), approach))
    return sorted(options, key=lambda option: option[0])


def _raised_grasps(asset: Asset) -> tuple[Grasp, ...]:
    return tuple(
        replace(grasp, position=(*grasp.position[:2], grasp.position[2] + RAISED_GRASP_OFFSET))
        for grasp in asset.grasps
        if asset.top - grasp.position[2] >= RAISED_GRASP_OFFSET + MIN_DEPTH_BELOW_TOP
    )


def _shifted_grasps(asset: Asset) -> tuple[Grasp, ...]:
    """Return the grasps of a flat box off its middle: towards an end, towards one side, or both."""
    # They leave room for the hand, or for a finger, between the box and an obstacle.
    grasps = []
    for grasp in asset.grasps:
        # A taller box would tip over.
        if grasp.symmetric or not asset.top - asset.bottom < grasp.width < WIDE_GRASP:
            continue
        across = np.array([np.cos(grasp.yaw), np.sin(grasp.yaw)])
        along = np.array([-across[1], across[0]])
        ends = max(0.0, float(np.abs(along) @ np.asarray(asset.half_extents)) - FINGER_HALF_WIDTH)
        side = (OPEN_WIDTH - grasp.width) / 2 - MIN_SIDE_GAP
        for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            x, y = np.asarray(grasp.position[:2]) + a * ends * along + b * side * across
            grasps.append(replace(grasp, position=(float(x), float(y), grasp.position[2])))
    return tuple(grasps)


def _cost(approach: _Approach, avoid: Array | None) -> float:
    hand, name = approach.hand, approach.name
    here, start = hand.sim.eef_pose()
    target, turn = approach.pose(OPEN_WIDTH)
    wrist = length(rotation_vector(turn @ start.T))
    cost = 0.3 * wrist + length(target - here) + finger_obstruction_cost(hand, name, target, turn)
    if avoid is not None:
        cost += 2.0 * abs(float(turn[:, 0] @ avoid))
    cost += 3.0 * abs(float(turn[:, 0] @ lean_from_fixtures(hand, name, target)))
    blocked = hand_penetration(hand, name, target, turn)
    if approach.shifted:  # without the margin: the hand pushes its neighbour by a few millimetres
        cost += SHIFTED_COST + 100.0 * max(0.0, blocked - HAND_MARGIN)
    else:
        cost += (0.0 if approach.reaching else 2.0) + 20.0 * blocked if blocked > 0.0 else 0.0
    cost += 0.3 if approach.grasp.width > WIDE_GRASP else 0.0
    position, _ = hand.sim.asset_pose(name)
    if _is_rim(hand, name, approach.grasp):
        cost += FAR_SIDE_COST * (1.0 + float(unit(target - position) @ hand.radial(position)))
    ends = [target] if approach.place is None else [target, approach.place + target - position]
    stretch = max(hand.stretch(end, turn) for end in ends)
    if approach.grasp.width >= TIGHT_GRASP and hand.strict:
        cost += TIGHT_COST * (2.0 if hand.stretch(target, turn) > MAX_STRETCH else 1.0)
    # Beyond `MAX_STRETCH` the hand stops short and closes on an edge, which slips.
    return cost + 20.0 * max(0.0, stretch - COMFORTABLE_STRETCH) + 40.0 * max(0.0, stretch - MAX_STRETCH)


def pick(
    hand: Hand, name: str, avoid: Array | None = None, place: Array | None = None
) -> Generator[NDArray[np.float32], None, Held | None]:
    """Grasp and lift an object; return it with its pose in the hand, None if all attempts failed.

    ``avoid``: horizontal direction (3,) along which the fingers should not close, because of the destination.
    ``place``: destination of the object's origin (3,), m; distant destinations need other grasps.
    """
    failed = 0
    for attempt in range(MAX_ATTEMPTS):
        approach = _choose_grasp(hand, name, failed, avoid, place)
        upright = hand.sim.asset_pose(name)[1][2, 2] if _is_rim(hand, name, approach.grasp) else -1.0
        yield from rise(hand, OPEN)
        yield from travel(hand, approach.above, approach.turned, OPEN, target=name)
        yield from hand.move(approach.above, approach.turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
        speed, timeout = (0.6, 60) if approach.grasp.width < TIGHT_GRASP else (TIGHT_GRASP_SPEED, 120)
        at, turned, stalled = approach.at, approach.turned, approach.stall_check()
        yield from hand.move(at, turned, OPEN, tolerance=0.005, speed=speed, timeout=timeout, give_up=stalled)
        # At a shifted grasp the first finger pushes the object to the other one, so the hand does not follow it.
        yield from hand.close(None if approach.shifted else approach.closing, hand.rotation)
        # After a miss retry at once, first at the same place. Otherwise policies would learn to lift an empty hand, or
        # to change the grasp without a visible reason.
        failed += attempt > 0 or not hand.empty
        missed = hand.empty or hand.sim.asset_pose(name)[1][2, 2] < upright - MAX_TIPPING
        held = None if missed else (yield from _lift(hand, name))
        if held is not None:
            return held
        yield from hand.wait(4, OPEN)
    return None


def _lift(hand: Hand, name: str) -> Generator[NDArray[np.float32], None, Held | None]:
    """Lift the grasped object; return its pose in the hand, None if it was not lifted, or its support was too."""
    start, _ = hand.sim.asset_pose(name)
    heights = {other: hand.sim.asset_pose(other)[0][2] for other in hand.sim.task.objects}
    # Retreat along the fingers: straight up for an upright hand, away from obstacles for a leaned one.
    lifted = hand.position - LIFT_HEIGHT * hand.rotation[:, 2]
    yield from hand.move(lifted, hand.rotation, CLOSED, tolerance=0.02, speed=0.7, timeout=60)
    now, turn = hand.sim.asset_pose(name)
    if hand.empty or now[2] - start[2] <= LIFT_HEIGHT * 0.5:
        return None
    position, rotation = hand.sim.eef_pose()
    if any(z < start[2] and hand.sim.asset_pose(other)[0][2] - z > LIFT_HEIGHT / 2 for other, z in heights.items()):
        yield from hand.move(position - LIFT_HEIGHT * UP, rotation, CLOSED, tolerance=0.02, timeout=40)
        return None
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
    """Move the held object's origin above a destination (3,) and lower it; stop early if it is dropped.

    ``turn``: rotation (3, 3) of the hand on arrival. ``clearance``: height of the approach above the destination, m.
    ``support``: ignored as an obstacle.
    """

    def at(height: float) -> Target:
        def target() -> Array:
            # Use the present pose in the hand: the object may have turned or slipped since the grasp.
            position, rotation = hand.sim.eef_pose()
            now, _ = hand.sim.asset_pose(held.name)
            return destination() - turn @ rotation.T @ (now - position) + height * UP

        return target

    def lost() -> bool:
        return not is_held(hand, held)

    position, rotation = hand.sim.eef_pose()
    high = max(float(position[2]), float(at(clearance)()[2]))
    up = np.array([position[0], position[1], high])
    yield from hand.move(up, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=60, give_up=lost)

    yield from travel(hand, at(clearance), lambda: turn, CLOSED, target=support, held=held, give_up=lost)

    def over() -> Array:
        target = at(clearance)()
        return np.array([target[0], target[1], max(target[2], high - 0.02)])

    for _ in range(MAX_ATTEMPTS if hand.strict else 1):
        yield from hand.move(over, turn, CLOSED, tolerance=0.012, turn_tolerance=0.08, give_up=lost)
        yield from hand.move(at(clearance), turn, CLOSED, tolerance=0.012, timeout=60, give_up=lost)
        if lost():
            return
        yield from hand.lower(at(0.0), turn, CLOSED, tolerance=tolerance)
        tipped = support in hand.sim.assets and hand.sim.asset_pose(support)[1][2, 2] < LEVEL_COSINE
        if not tipped and length((hand.position - at(0.0)())[:2]) < MAX_RELEASE_OFFSET:
            return  # otherwise a push moved the hand aside: over the rim of a bowl, or in the air


def _upright(hand: Hand, held: Held) -> Array:
    """Return the hand's rotation (3, 3) that sets the held object upright without changing its yaw."""
    _, now = hand.sim.asset_pose(held.name)
    tilt = cross(now[:, 2], UP)
    angle = float(np.arctan2(np.linalg.norm(tilt), now[2, 2]))
    if angle > MAX_RIGHTING_TILT:
        return hand.rotation
    return Rotation.from_rotvec(unit(tilt) * angle).as_matrix() @ hand.rotation


def put_on(hand: Hand, held: Held, support: str) -> Steps:
    """Place the held object on the centre of another object."""
    asset, below = hand.sim.assets[held.name], hand.sim.assets[support]
    # An object wider than a bowl's floor rests on its wall near the rim.
    height = below.supports if asset.radius <= below.clear_radius else below.top - 0.012
    turn = _upright(hand, held)

    def destination() -> Array:
        position, rotation = hand.sim.asset_pose(support)
        _, tilt = hand.sim.asset_pose(held.name)
        drop = -asset.bottom if tilt[2, 2] > 0.9 else asset.radius * 0.6
        return position + rotation @ np.array([0.0, 0.0, height]) + (drop + gap) * UP

    # An object that falls further is caught by a rising finger, such as LIBERO's milk carton by its eaves.
    gap, tolerance = (0.0, 0.004) if hand.strict else (0.008, 0.006)
    clearance = max(0.08, below.top - height + 0.06)
    yield from carry(hand, held, destination, turn, clearance, tolerance, support=support)
    yield from release_object(hand)


def put_on_region(hand: Hand, held: Held, position: Array) -> Steps:
    """Place the held object with its origin above a position (3,) of a horizontal surface."""
    asset = hand.sim.assets[held.name]
    turn = _upright(hand, held)
    yield from carry(hand, held, lambda: position + (0.006 - asset.bottom) * UP, turn, clearance=0.10, tolerance=0.008)
    yield from release_object(hand)


def put_at(hand: Hand, held: Held, position: Array, rotation: Array) -> Steps:
    """Place the held object with its origin at a position (3,) and with a rotation (3, 3)."""
    yield from carry(hand, held, lambda: position + 0.004 * UP, rotation @ held.turn.T, clearance=0.08)
    yield from release_object(hand)


def put_in_drawer(hand: Hand, held: Held, region: str, outward: Array) -> Steps:
    """Drop the held object into an open drawer."""
    height = region_box(hand, region)[2][2]
    asset = hand.sim.assets[held.name]
    # Close along the front: the hand is 20 cm wide in that direction and would otherwise hit the cabinet.
    turn = frame(DOWN, cross(UP, outward))

    def destination() -> Array:
        centre, _ = hand.sim.site_pose(region)
        return centre + 0.015 * outward + (height - asset.bottom - 0.005) * UP - 0.02 * UP

    for _ in range(MAX_ATTEMPTS):
        yield from carry(hand, held, destination, turn, clearance=0.12, tolerance=0.012)
        if not is_held(hand, held) or length(hand.sim.asset_pose(held.name)[0] - destination()) < MAX_DRAWER_OFFSET:
            break
    yield from release_object(hand)
