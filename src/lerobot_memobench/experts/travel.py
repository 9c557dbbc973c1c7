"""The space around the hand: what stands in its way, how it leans, and its ways through the air."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lerobot_memobench.experts.hand import (
    COMFORTABLE,
    DOWN,
    OPEN,
    STRETCHED,
    UP,
    Array,
    Hand,
    Steps,
    cross,
    frame,
    length,
    unit,
)
from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.robot import BASE_POSITION
from lerobot_memobench.tasks.formula import Atom

LOST = 0.05
"""Distance between hand and thing, beyond that at the grasp, at which it counts as dropped, m."""
HOME = Atom("handhome", ())
SETTLING = 18
"""Control steps within which a hand comes to rest at home, once it is near."""
HAND_BESIDE = 0.05
"""How far the hand reaches sideways on its way, m."""
PRESSED = 2
"""Steps for which what has a stop is pushed on against it: fewer than the six that a policy executes of a plan, or a
policy that does not see the difference would plan them again and again."""

FINGER_REACH = 0.0095
"""How far the finger tips stand out under the grip site, m."""
FINGER_THICKNESS = 0.014
"""Of a finger's tip along the closing axis, m."""
FULLY_OPEN = 0.079
"""Distance between the open fingers, m."""
BLOCKED, BLOCKED_COST = 0.010, 2.0
"""Level distance between the middle of a finger's tip and a thing, m, under which it comes down on that, and the
penalty: who learns from it learns a grasp that fails before the one that does not."""
HAND_MARGIN = 0.006
"""Room left between the hand and its neighbours, m."""
HAND_POINTS = np.array(
    [(x, y, -z) for x in (-0.1, -0.05, 0.0, 0.05, 0.1) for y in (-0.032, 0.0, 0.032) for z in (0.05, 0.08, 0.11)]
    + [(x, y, -z) for x in (-0.05, 0.0, 0.05) for y in (-0.05, 0.0, 0.05) for z in (0.14, 0.18)]
)
"""Places on palm and wrist in the grip site's frame (N, 3), m."""
MOST_OVER = 0.022
"""By how much a thing may be higher than a drawer's room and still go in with it, m."""
CLEAR = 0.025
"""Height left over what stands on the way, m."""

BESIDE = 0.085
"""Horizontal distance from the grip site within which something tall is in the hand's way, m."""
MOST_LEAN = np.radians(32)
"""How far the hand leans at most to keep clear of something or to reach a far place, rad."""
UNDER_LEAN = np.radians(44)
"""The same for what lies under something, rad."""
DRAWER_LEAN = np.radians(14)
"""How far the hand leans out of the front to reach into a drawer: clear of the handles above, and of its own front."""
MORE_LEAN = (0.0, 0.12, -0.12, 0.24, -0.24, 0.36, -0.36, 0.48, -0.48)
"""Leans tried, in this order, to keep the hand off its neighbours, rad."""


# --- surroundings: what the hand would touch at a place or on its way ---


def corners(asset: Asset) -> Array:
    """Return the corners (3, 8) of an asset's bounding box in its frame, m."""
    return np.array(np.meshgrid(*zip(asset.low, asset.high, strict=True))).reshape(3, -1)


def outward_of(hand: Hand, articulation: Articulation) -> Array:
    """Return the horizontal direction (3,) in which a drawer opens."""
    axis = hand.sim.data.joint(articulation.joint).xaxis * np.sign(articulation.open_q - articulation.closed_q)
    outward = axis * np.array([1.0, 1.0, 0.0])
    return outward / np.linalg.norm(outward)


def drawer_around(hand: Hand, name: str) -> str | None:
    """Return the region of the drawer in which a thing lies, if any."""
    for asset in hand.sim.assets.values():
        for region, articulation in asset.articulations.items():
            if articulation.kind == "drawer" and hand.sim.holds(Atom("in", (name, asset.regions[region]))):
                return asset.regions[region]
    return None


def stands_out(hand: Hand, name: str, region: str) -> bool:
    """Say whether a thing in a drawer is so far above it that the drawer cannot be shut: a bowl that leans, say."""
    position, rotation = hand.sim.asset_pose(name)
    highest = position[2] + (rotation @ corners(hand.sim.assets[name]))[2].max()
    centre, _, half = region_box(hand, region)
    over: float = highest - centre[2] - half[2]
    return over > MOST_OVER


def region_box(hand: Hand, region: str) -> tuple[Array, Array, Array]:
    """Return centre (3,), rotation (3, 3) and half size (3,) of a region, the third axis pointing up.

    LIBERO's drawers have sites that lie on a side.
    """
    centre, rotation = hand.sim.site_pose(region)
    half = hand.sim.site_half_size(region)
    upright = int(np.argmax(np.abs(rotation[2])))
    if upright == 2:
        return centre, rotation, half
    order = [(upright + 1) % 3, (upright + 2) % 3, upright]
    up = np.sign(rotation[2, upright])
    return centre, rotation[:, order] * np.array([up, 1.0, up]), half[order]


def tall_boxes(hand: Hand, name: str) -> list[tuple[Array, Array, Array]]:
    """Return centre, rotation and half size of fixtures and of drawers with their handles, (3,), (3, 3), (3,)."""
    boxes = []
    for other, asset in hand.sim.assets.items():
        if asset.kind != "fixture" or other == name:
            continue
        position, rotation = hand.sim.asset_pose(other)
        low, high = np.asarray(asset.low), np.asarray(asset.high)
        boxes.append((position + rotation @ (low + high) / 2, rotation, (high - low) / 2))
        for region, articulation in asset.articulations.items():
            if articulation.kind == "drawer":
                boxes.append(_drawer_box(hand, asset.regions[region], articulation.handle_site))
    return boxes


def _drawer_box(hand: Hand, region: str, handle_site: str) -> tuple[Array, Array, Array]:
    centre, turned, half = region_box(hand, region)
    handle, _ = hand.sim.site_pose(handle_site)
    reach = np.abs(turned.T @ (handle - centre)) + 0.008
    return centre, turned, np.maximum(half + 0.012, reach)


def in_the_way(hand: Hand, name: str, target: Array, turn: Array) -> float:
    """Return how deep palm and wrist would stand in other objects, m, 0 where they are clear of them."""
    points = target + HAND_POINTS @ turn.T
    deepest = 0.0
    for other, asset in hand.sim.assets.items():
        if asset.kind == "fixture" or other == name:
            continue
        position, rotation = hand.sim.asset_pose(other)
        low, high = np.asarray(asset.low), np.asarray(asset.high)
        local = (points - position) @ rotation - (low + high) / 2
        depth = ((high - low) / 2 + HAND_MARGIN - np.abs(local)).min(axis=1)
        deepest = max(deepest, float(depth.max()))
    return deepest


def crowding(hand: Hand, name: str, target: Array, turn: Array) -> float:
    """Return a penalty for other things standing where the open fingers would go down."""
    penalty = 0.0
    apart = FULLY_OPEN / 2 + FINGER_THICKNESS / 2
    for other, asset in hand.sim.assets.items():
        if other == name or asset.kind == "fixture":
            continue
        position, rotation = hand.sim.asset_pose(other)
        if position[2] + asset.top < target[2] - FINGER_REACH:
            continue
        for side in (-1.0, 1.0):
            gap = _gap(asset, rotation.T @ (target + side * apart * turn[:, 0] - position))
            penalty += 40.0 * max(0.0, FINGER_THICKNESS - gap) + BLOCKED_COST * (gap < BLOCKED)
    return penalty


def _gap(asset: Asset, local: Array) -> float:
    """Return the level distance of a place in an asset's frame from its outline, m; not above 0 inside."""
    if asset.round:
        return float(np.hypot(local[0], local[1])) - asset.radius
    outside = np.maximum(np.abs(local[:2]) - np.asarray(asset.half_extents), 0.0)
    return float(np.hypot(*outside))


def clear_height(hand: Hand, start: Array, end: Array, *, lowest: float, wide: float, but: tuple[str, ...]) -> float:
    """Return the height for the hand at which nothing is touched on a level way, m.

    Args:
        hand: the arm.
        start, end: the way, (3,).
        lowest: how far what the hand carries reaches down under the grip site, m.
        wide: how far it reaches sideways, m.
        but: things that are not in the way: what is carried or taken, and what it is put on.
    """
    way = start + np.linspace(0.0, 1.0, 16)[:, None] * (end - start)
    height = 0.0
    for other, asset in hand.sim.assets.items():
        if asset.kind == "fixture" or other in but:
            continue
        position, rotation = hand.sim.asset_pose(other)
        gap = float(np.linalg.norm((way - position)[:, :2], axis=1).min()) - asset.radius - wide
        if gap < 0.0:
            height = max(height, float(position[2] + (rotation @ corners(asset))[2].max()))
    for centre, rotation, half in tall_boxes(hand, ""):
        local = (way - centre) @ rotation
        outside = np.abs(local[:, :2]) - half[:2]
        if bool(np.any(np.all(outside < wide, axis=1))):
            height = max(height, float(centre[2] + half[2]))
    return height + lowest + CLEAR if height > 0.0 else 0.0


# --- leaning: away from what stands beside a thing, towards the arm where a thing is far ---


def leaning(closing: Array, away: Array) -> Array:
    """Return the rotation (3, 3) of a hand that points down, its wrist leaning along ``away`` by its length, rad."""
    size = length(away)
    return frame(DOWN - np.tan(min(size, UNDER_LEAN)) * unit(away), closing)


def clear_of_objects(
    hand: Hand, name: str, target: Array, closing: Array, away: Array, reaching: bool = False
) -> Array:
    """Return the hand's rotation (3, 3), leaning by ``away`` or by what else keeps it off tall things beside.

    Where it is ``reaching``, a lean that stretches the arm too far is as bad as one that stands in them as deep.
    """
    side = cross(UP, closing)
    best, least = leaning(closing, away), np.inf
    for more in MORE_LEAN:
        if abs(float(away @ side) + more) > MOST_LEAN and more != 0.0:
            continue
        turn = leaning(closing, away + more * side)
        bad = in_the_way(hand, name, target, turn)
        if reaching:
            bad += max(0.0, hand.stretch(target, turn) - STRETCHED)
        if bad < least - 0.002:
            best, least = turn, bad
        if least <= 0.0:
            break
    return best


def reach_lean(hand: Hand, place: Array, stretch: float = COMFORTABLE) -> Array:
    """Return by how much and whither the hand should lean to reach a far place with a bent elbow, (3,), rad."""
    inward = -hand.radial(place)
    for angle in np.linspace(0.0, MOST_LEAN, 8):
        approach = np.cos(angle) * DOWN - np.sin(angle) * inward
        if hand.stretch(place, frame(approach, cross(UP, inward))) < stretch:
            break
    return float(angle) * inward


def pointing(hand: Hand, place: Array) -> Array:
    """Return the rotation (3, 3) of a hand that points down at a place, leaning where it is far."""
    lean = reach_lean(hand, place)
    return leaning(cross(UP, hand.radial(place)), lean)


def lean_from_fixtures(hand: Hand, name: str, target: Array) -> Array:
    """Return by how much and whither the hand should lean to keep clear of tall fixtures beside it, (3,), rad."""
    drawer = drawer_around(hand, name)
    if drawer is not None:
        return DRAWER_LEAN * outward_of(hand, hand.sim.world.articulation(drawer)[0])
    lean = np.zeros(3)
    for centre, rotation, half in tall_boxes(hand, name):
        local = rotation.T @ (target - centre)
        if local[2] + 0.03 <= half[2]:
            lean += _lean_from_box(local, rotation, half)
    size = length(lean)
    return lean * min(1.0, UNDER_LEAN / size) if size > 0 else lean


def _lean_from_box(local: Array, rotation: Array, half: Array) -> Array:
    """Return the lean of a hand from one box, whose frame ``local`` (3,) is in."""
    outside = local - np.clip(local, -half, half)
    outside[2] = 0.0
    gap = length(outside)
    if gap >= BESIDE:
        return np.zeros(3)
    if gap > 1e-6:
        return rotation @ outside / gap * MOST_LEAN * min(1.0, 1.6 * (1.0 - gap / BESIDE))
    # Under it, as under an open drawer: in from the nearest side.
    room = half[:2] - np.abs(local[:2])
    side = int(np.argmin(room))
    way = np.zeros(3)
    way[side] = np.sign(local[side]) or 1.0
    return rotation @ way * UNDER_LEAN


def far(place: Array) -> float:
    """Return how far a place is from the arm's foot, level, m."""
    return length(place[:2] - np.asarray(BASE_POSITION[:2]))


# --- ways: up, over what stands there, and home; with or without a thing in the hand ---


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
    now, _ = hand.sim.asset_pose(held.name)
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
    position, rotation = hand.sim.asset_pose(held.name)
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
