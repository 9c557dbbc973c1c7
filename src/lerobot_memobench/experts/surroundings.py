"""What stands around: what the hand would touch at a place or on its way."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.experts.hand import Array, Hand
from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.tasks.formula import Atom

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
    position, rotation = hand.sim.body_pose(name)
    highest = position[2] + (rotation @ corners(hand.sim.assets[name]))[2].max()
    over: float = highest - hand.sim.site_pose(region)[0][2] - hand.sim.site_half_size(region)[2]
    return over > MOST_OVER


def tall_boxes(hand: Hand, name: str) -> list[tuple[Array, Array, Array]]:
    """Return centre, rotation and half size of fixtures and of drawers with their handles, (3,), (3, 3), (3,)."""
    boxes = []
    for other, asset in hand.sim.assets.items():
        if asset.kind != "fixture" or other == name:
            continue
        position, rotation = hand.sim.body_pose(other)
        low, high = np.asarray(asset.low), np.asarray(asset.high)
        boxes.append((position + rotation @ (low + high) / 2, rotation, (high - low) / 2))
        for region, articulation in asset.articulations.items():
            if articulation.kind == "drawer":
                boxes.append(_drawer_box(hand, asset.regions[region], articulation.handle_site))
    return boxes


def _drawer_box(hand: Hand, region: str, handle_site: str) -> tuple[Array, Array, Array]:
    centre, turned = hand.sim.site_pose(region)
    handle, _ = hand.sim.site_pose(handle_site)
    reach = np.abs(turned.T @ (handle - centre)) + 0.008
    return centre, turned, np.maximum(hand.sim.site_half_size(region) + 0.012, reach)


def in_the_way(hand: Hand, name: str, target: Array, turn: Array) -> float:
    """Return how deep palm and wrist would stand in other objects, m, 0 where they are clear of them."""
    points = target + HAND_POINTS @ turn.T
    deepest = 0.0
    for other, asset in hand.sim.assets.items():
        if asset.kind == "fixture" or other == name:
            continue
        position, rotation = hand.sim.body_pose(other)
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
        position, rotation = hand.sim.body_pose(other)
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
        position, rotation = hand.sim.body_pose(other)
        gap = float(np.linalg.norm((way - position)[:, :2], axis=1).min()) - asset.radius - wide
        if gap < 0.0:
            height = max(height, float(position[2] + (rotation @ corners(asset))[2].max()))
    for centre, rotation, half in tall_boxes(hand, ""):
        local = (way - centre) @ rotation
        outside = np.abs(local[:, :2]) - half[:2]
        if bool(np.any(np.all(outside < wide, axis=1))):
            height = max(height, float(centre[2] + half[2]))
    return height + lowest + CLEAR if height > 0.0 else 0.0
