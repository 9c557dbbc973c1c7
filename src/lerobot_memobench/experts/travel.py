"""Avoid obstacles: detect collisions of the hand, choose its lean, and move it along collision-free paths."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.experts.hand import (
    COMFORTABLE_STRETCH,
    DOWN,
    MAX_STRETCH,
    OPEN,
    UP,
    Array,
    Hand,
    Steps,
    cross,
    frame,
    length,
    unit,
)
from lerobot_memobench.sim.asset import TABLE_TOP, Articulation, Asset
from lerobot_memobench.sim.robot import BASE_POSITION
from lerobot_memobench.tasks.formula import Atom

DROP_DISTANCE = 0.05  # displacement of a held object in the hand from which it counts as dropped, m
HAND_HOME = Atom("handhome", ())
MAX_SETTLING_STEPS = 18  # maximum number of control steps for settling at home
HAND_HALF_WIDTH = 0.05  # lateral extent of the hand in transit, m
PRESS_STEPS = 2
"""Steps of pushing against a joint's stop. Fewer than the six steps a policy executes per plan; otherwise a policy that
cannot observe the contact would plan them repeatedly."""
RELEASE_GAP, MAX_RELEASE_STEPS = 0.004, 6
"""Increase of the finger opening at which an object is released, m, and largest number of steps waited for it."""

FINGER_REACH = 0.0095  # length of the finger tips below the grip site, m
FINGER_THICKNESS = 0.014  # thickness of a finger tip along the closing axis, m
OPEN_WIDTH = 0.079  # distance between the open fingers, m
BLOCKED_DISTANCE, BLOCKED_COST = 0.010, 2.0
"""Horizontal distance between the centre of a finger tip and an object below which the finger collides with it, m, and
the cost: policies would learn the failing grasp first."""
HAND_MARGIN = 0.006  # margin between the hand and other objects, m
HAND_POINTS = np.array(
    [(x, y, -z) for x in (-0.1, -0.05, 0.0, 0.05, 0.1) for y in (-0.032, 0.0, 0.032) for z in (0.05, 0.08, 0.11)]
    + [(x, y, -z) for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.0, 0.05) for z in (0.14, 0.18)]
    + [(x, y, -0.105) for x in (-0.02, 0.02) for y in (-0.045, 0.045)]  # rim of the flange
)
"""Points on palm and wrist in the grip site's frame (N, 3), m."""
MAX_DRAWER_EXCESS = 0.022  # largest height by which an object may exceed a drawer's region without blocking it, m
TRAVEL_CLEARANCE = 0.025  # vertical clearance over obstacles, m

OBSTACLE_DISTANCE = 0.085
"""Horizontal distance from the grip site within which a tall obstacle affects the hand's lean, m."""
MAX_LEAN = np.radians(32)  # largest lean for obstacle avoidance or reach, rad
MAX_LEAN_UNDER = np.radians(44)  # largest lean for objects below an obstacle, rad
DRAWER_LEAN = np.radians(14)
"""Lean in the opening direction inside a drawer: avoids the handles above and the drawer's front, rad."""
LEAN_CANDIDATES = (0.0, 0.12, -0.12, 0.24, -0.24, 0.36, -0.36, 0.48, -0.48)
"""Additional leans, in the order of evaluation, rad."""


# --- obstacles ---


def corners(asset: Asset) -> Array:
    """Return the corners (3, 8) of an asset's bounding box in its frame, m."""
    return np.array(np.meshgrid(*zip(asset.low, asset.high, strict=True))).reshape(3, -1)


def opening_direction(hand: Hand, articulation: Articulation) -> Array:
    """Return the horizontal direction (3,) in which a drawer opens."""
    axis = hand.sim.data.joint(articulation.joint).xaxis * np.sign(articulation.open_q - articulation.closed_q)
    outward = axis * np.array([1.0, 1.0, 0.0])
    return outward / np.linalg.norm(outward)


def drawer_containing(hand: Hand, name: str) -> str | None:
    """Return the region of the drawer that contains an object, None without one."""
    for region, (articulation, _) in hand.sim.world.joints.items():
        if articulation.kind == "drawer" and hand.sim.holds(Atom("in", (name, region))):
            return region
    return None


def protrudes_from_drawer(hand: Hand, name: str, region: str) -> bool:
    """Return whether an object protrudes from a drawer and blocks it, such as a leaning bowl."""
    position, rotation = hand.sim.asset_pose(name)
    highest = position[2] + (rotation @ corners(hand.sim.assets[name]))[2].max()
    centre, _, half = region_box(hand, region)
    over: float = highest - centre[2] - half[2]
    return over > MAX_DRAWER_EXCESS


def region_box(hand: Hand, region: str) -> tuple[Array, Array, Array]:
    """Return centre (3,), rotation (3, 3) and half size (3,) of a region, with the third axis up."""
    centre, rotation = hand.sim.site_pose(region)
    half = hand.sim.site_half_size(region)
    upright = int(np.argmax(np.abs(rotation[2])))  # another axis in the site frames of LIBERO's drawers
    if upright == 2:
        return centre, rotation, half
    order = [(upright + 1) % 3, (upright + 2) % 3, upright]
    up = np.sign(rotation[2, upright])
    return centre, rotation[:, order] * np.array([up, 1.0, up]), half[order]


def obstacle_boxes(hand: Hand, name: str) -> list[tuple[Array, Array, Array]]:
    """Return centre (3,), rotation (3, 3) and half size (3,) of each fixture and each drawer with its handle."""
    boxes = []
    for other, asset in hand.sim.assets.items():
        if asset.kind != "fixture" or other == name:
            continue
        position, rotation = hand.sim.asset_pose(other)
        low, high = np.asarray(asset.low), np.asarray(asset.high)
        boxes.append((position + rotation @ (low + high) / 2, rotation, (high - low) / 2))
        for region, articulation in asset.articulations.items():
            if articulation.kind == "drawer":
                centre, turned, half = region_box(hand, asset.regions[region])
                handle, _ = hand.sim.site_pose(articulation.handle_site)
                reach = np.abs(turned.T @ (handle - centre)) + 0.008
                boxes.append((centre, turned, np.maximum(half + 0.012, reach)))
    return boxes


def _objects(hand: Hand, *but: str) -> Iterator[tuple[Asset, Array, Array]]:
    for name, asset in hand.sim.assets.items():
        if asset.kind == "object" and name not in but:
            yield asset, *hand.sim.asset_pose(name)


def hand_penetration(hand: Hand, name: str, target: Array, turn: Array, margin: float = HAND_MARGIN) -> float:
    """Return the largest penetration of palm and wrist into other objects for a grasp, m; 0 without collision."""
    points = target + HAND_POINTS @ turn.T
    deepest = 0.0
    for asset, position, rotation in _objects(hand, name):
        low, high = np.asarray(asset.low), np.asarray(asset.high)
        local = (points - position) @ rotation - (low + high) / 2
        depth = ((high - low) / 2 + margin - np.abs(local)).min(axis=1)
        deepest = max(deepest, float(depth.max()))
    return deepest


def finger_obstruction_cost(hand: Hand, name: str, target: Array, turn: Array) -> float:
    """Return a cost for other objects below the open fingers."""
    penalty = 0.0
    apart = OPEN_WIDTH / 2 + FINGER_THICKNESS / 2
    for asset, position, rotation in _objects(hand, name):
        if position[2] + asset.top < target[2] - FINGER_REACH:
            continue
        for side in (-1.0, 1.0):
            finger = rotation.T @ (target + side * apart * turn[:, 0] - position)
            outside = np.maximum(np.abs(finger[:2]) - np.asarray(asset.half_extents), 0.0)
            gap = float(np.hypot(*finger[:2])) - asset.radius if asset.round else float(np.hypot(*outside))
            penalty += 40.0 * max(0.0, FINGER_THICKNESS - gap) + BLOCKED_COST * (gap < BLOCKED_DISTANCE)
    return penalty


def clear_height(hand: Hand, start: Array, end: Array, *, lowest: float, wide: float, but: Iterable[str]) -> float:
    """Return the height of the hand for a collision-free horizontal path, m; 0 without obstacles.

    ``lowest``, ``wide``: extent of hand and load below the grip site and to its sides, m. ``but``: the carried or
    grasped object and its support.
    """
    way = start + np.linspace(0.0, 1.0, 16)[:, None] * (end - start)
    height = 0.0
    for asset, position, rotation in _objects(hand, *but):
        gap = float(np.linalg.norm((way - position)[:, :2], axis=1).min()) - asset.radius - wide
        if gap < 0.0:
            height = max(height, float(position[2] + (rotation @ corners(asset))[2].max()))
    for centre, rotation, half in obstacle_boxes(hand, ""):
        local = (way - centre) @ rotation
        outside = np.abs(local[:, :2]) - half[:2]
        if bool(np.any(np.all(outside < wide, axis=1))):
            height = max(height, float(centre[2] + half[2]))
    return height + lowest + TRAVEL_CLEARANCE if height > 0.0 else 0.0


# --- lean: away from obstacles, towards the base for distant targets ---


def leaned_rotation(closing: Array, away: Array) -> Array:
    """Return the rotation (3, 3) of a downward hand with its wrist leaned along ``away`` by its length, rad."""
    size = length(away)
    return frame(DOWN - np.tan(min(size, MAX_LEAN_UNDER)) * unit(away), closing)


def clear_of_objects(
    hand: Hand, name: str, target: Array, closing: Array, away: Array, reaching: bool, largest: float
) -> Array:
    """Return the hand's rotation (3, 3), leaned by ``away`` plus the candidate with the least collision.

    With ``reaching``, excess stretch of the arm counts like penetration of the same length. Leans up to ``largest``
    are tried, rad.
    """
    side = cross(UP, closing)
    best, least_cost = leaned_rotation(closing, away), np.inf
    for more in (largest / MAX_LEAN * candidate for candidate in LEAN_CANDIDATES):
        if abs(float(away @ side) + more) > largest and more != 0.0:
            continue
        turn = leaned_rotation(closing, away + more * side)
        cost = hand_penetration(hand, name, target, turn)
        if reaching:
            cost += max(0.0, hand.stretch(target, turn) - MAX_STRETCH)
        if cost < least_cost - 0.002:
            best, least_cost = turn, cost
        if least_cost <= 0.0:
            break
    return best


def reach_lean(hand: Hand, place: Array, stretch: float = COMFORTABLE_STRETCH) -> Array:
    """Return the lean (3,) that reaches a position with a bent elbow: direction times angle, rad."""
    inward = -hand.radial(place)
    for angle in np.linspace(0.0, MAX_LEAN, 8):
        approach = np.cos(angle) * DOWN - np.sin(angle) * inward
        if hand.stretch(place, frame(approach, cross(UP, inward))) < stretch:
            break
    return float(angle) * inward


def pointing(hand: Hand, place: Array) -> Array:
    """Return the rotation (3, 3) of a hand that points down at a position, leaned if it is distant."""
    lean = reach_lean(hand, place)
    return leaned_rotation(cross(UP, hand.radial(place)), lean)


def lean_from_fixtures(hand: Hand, name: str, target: Array) -> Array:
    """Return the lean (3,) away from tall fixtures: direction times angle, rad."""
    drawer = drawer_containing(hand, name)
    if drawer is not None:
        return DRAWER_LEAN * opening_direction(hand, hand.sim.world.articulation(drawer)[0])
    lean = np.zeros(3)
    for centre, rotation, half in obstacle_boxes(hand, name):
        local = rotation.T @ (target - centre)
        outside = local - np.clip(local, -half, half)
        outside[2] = 0.0
        gap = length(outside)
        if local[2] + 0.03 > half[2] or gap >= OBSTACLE_DISTANCE:
            continue
        if gap > 1e-6:
            lean += rotation @ outside / gap * MAX_LEAN * min(1.0, 1.6 * (1.0 - gap / OBSTACLE_DISTANCE))
        else:  # below the box, such as an open drawer: approach from the nearest side
            side = int(np.argmin(half[:2] - np.abs(local[:2])))
            way = np.zeros(3)
            way[side] = np.sign(local[side]) or 1.0
            lean += rotation @ way * MAX_LEAN_UNDER
    size = length(lean)
    return lean * min(1.0, MAX_LEAN_UNDER / size) if size > 0 else lean


def distance_from_base(place: Array) -> float:
    """Return the horizontal distance of a position from the arm's base, m."""
    return length(place[:2] - np.asarray(BASE_POSITION[:2]))


# --- paths ---


@dataclass
class Held:
    """A grasped object and its pose in the hand."""

    name: str
    offset: Array  # origin of the object in the hand's frame, (3,), m
    turn: Array  # rotation of the object in the hand's frame, (3, 3)


def is_held(hand: Hand, held: Held) -> bool:
    """Return whether the object is still near its pose in the hand at the grasp."""
    position, rotation = hand.sim.eef_pose()
    now, _ = hand.sim.asset_pose(held.name)
    return length(rotation.T @ (now - position) - held.offset) < DROP_DISTANCE


def sustained(reached: Callable[[], bool]) -> Callable[[], bool]:
    """Return a condition, evaluated once per step, that is true after ``reached`` has held for `PRESS_STEPS` steps."""
    count = 0  # a policy that imitates the motion less exactly and stops some steps earlier still closes the joint

    def condition() -> bool:
        nonlocal count
        count = count + 1 if reached() else 0
        return count > PRESS_STEPS

    return condition


def rise(hand: Hand, gripper: float, least: float = 0.12) -> Steps:
    """Move straight up to a height above the table."""
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
    """Move above a position, over all obstacles on the path; a free path needs no motion."""
    start, end = hand.position, place()
    lowest, wide, but = FINGER_REACH, HAND_HALF_WIDTH, [target]
    if held is not None:
        asset, (position, rotation) = hand.sim.assets[held.name], hand.sim.asset_pose(held.name)
        below = float(start[2] - position[2] - (rotation @ corners(asset))[2].min())
        lowest, wide, but = max(lowest, below), max(wide, asset.radius), [target, held.name]
    height = clear_height(hand, start, end, lowest=lowest, wide=wide, but=but)
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


def release_fixture(hand: Hand, height: float = 0.12) -> Steps:
    """Open the fingers, then move straight up."""
    yield from hand.open(6)
    up = hand.position + height * UP
    yield from hand.move(up, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)


def release_object(hand: Hand) -> Steps:
    """Move up while the fingers open: fully open inside a bowl they would press against its wall and lift it."""
    # Before that the fingers leave the object: a rising pad hooks under the eaves of LIBERO's light milk carton.
    grip = hand.sim.gripper_opening()
    yield from hand.open(3)
    for _ in range(MAX_RELEASE_STEPS):
        if hand.sim.gripper_opening() > grip + RELEASE_GAP:
            break
        yield from hand.open(1)
    target = hand.position + 0.12 * UP
    yield from hand.move(target, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, speed=0.7, timeout=60)


def go_home(hand: Hand, position: Array, rotation: Array) -> Steps:
    """Rise and return to a pose with open fingers."""
    yield from rise(hand, OPEN, 0.2)
    yield from hand.move(position, rotation, OPEN, tolerance=0.012, turn_tolerance=0.08)


def come_home(hand: Hand, position: Array, rotation: Array) -> Steps:
    """Return to the home pose and come to rest there; a hand at home does not move."""
    if hand.sim.holds(HAND_HOME):
        return
    yield from go_home(hand, position, rotation)
    for _ in range(MAX_SETTLING_STEPS):
        if hand.sim.holds(HAND_HOME):
            break
        yield hand.toward(position, rotation, OPEN)
