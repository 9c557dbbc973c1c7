"""How the hand leans: away from what stands beside a thing, and towards the arm where a thing is far."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.experts.hand import COMFORTABLE, DOWN, STRETCHED, UP, Array, Hand, cross, frame, length, unit
from lerobot_memobench.experts.surroundings import drawer_around, in_the_way, outward_of, tall_boxes
from lerobot_memobench.sim.robot import BASE_POSITION

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
