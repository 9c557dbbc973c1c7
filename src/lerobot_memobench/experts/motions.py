"""A handful of closed-loop motions: pick, place, open, close, turn.

Each is a generator of actions that looks at the simulator before every action and returns whether it worked, so a plan
composes them with ``yield from`` and tries again where one missed.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.hand import CLOSED, DOWN, OPEN, UP, Array, Hand, downward, frame
from lerobot_memobench.sim.assets.base import Articulation, Grasp
from lerobot_memobench.sim.scene import TABLE_TOP

Doing = Generator[NDArray[np.float32], None, bool]
"""A motion: yields actions (7,), returns whether it did what it is for."""

ATTEMPTS = 4
LIFT = 0.10
"""How high a thing is lifted before it is carried, m."""
HOVER = 0.09
"""Height over a grasp at which the hand turns and aligns, m."""
LOST = 0.05
"""Distance between hand and thing, beyond that at the grasp, at which it counts as dropped, m."""
FINGER_REACH = 0.0095
"""How far the finger tips stand out under the grip site, m."""
BESIDE = 0.085
"""Horizontal distance from the grip site within which something tall is in the hand's way, m."""
MOST_LEAN = np.radians(32)
FINGER_THICKNESS = 0.014
"""Of a finger's tip along the closing axis, m."""
FULLY_OPEN = 0.079
"""Distance between the open fingers, m."""
RIM_GAP = 0.004
"""Room left between a rim and the inner finger while the hand comes down, m."""
CLOSING_LEAD = 0.03
"""How much narrower than they are the fingers are taken to be while they close: the arm is slower than they, m."""
EMPTY = 0.003
"""Opening under which the fingers hold nothing, m."""


@dataclass
class Held:
    """What the hand holds and how."""

    name: str
    offset: Array
    """Origin of the thing in the hand's frame, (3,), m."""
    turn: Array
    """Rotation of the thing in the hand's frame, (3, 3)."""


def _yaw(rotation: Array) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _grasp_pose(
    hand: Hand, name: str, grasp: Grasp, spin: float, opening: float | None = None
) -> tuple[Array, Array]:
    """Return where the grip site goes to take ``name``, and how the hand is turned there.

    A rim is taken with the inner finger close to the wall, however wide the fingers stand: the hand comes in from
    outside and follows the outer finger as it closes. What lies in the bowl is not touched.
    """
    opening = hand.sim.gripper_opening() if opening is None else opening
    position, rotation = hand.sim.body_pose(name)
    spun = rotation @ Rotation.from_rotvec([0.0, 0.0, spin]).as_matrix()
    target = position + spun @ np.asarray(grasp.position)
    if _is_rim(hand, name, grasp):
        outward = spun[:, 0] * np.sign(grasp.position[0])
        target = target + outward * max(0.0, opening / 2 - grasp.width / 2 - RIM_GAP)
    target[2] = max(target[2], TABLE_TOP + FINGER_REACH)
    turn = downward(_yaw(rotation) + spin + grasp.yaw)
    lean = _lean(hand, name, target)
    # Only about the closing axis: the fingers stay level and the thin side of the hand turns away.
    away = lean - (lean @ turn[:, 0]) * turn[:, 0]
    return target, frame(DOWN - np.tan(np.linalg.norm(away)) * _unit(away), turn[:, 0])


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _lean(hand: Hand, name: str, target: Array) -> Array:
    """Return by how much and whither the hand should lean to keep clear of tall fixtures beside it, (3,), rad."""
    lean = np.zeros(3)
    for centre, rotation, half in _tall_boxes(hand, name):
        local = rotation.T @ (target - centre)
        if local[2] + 0.03 > half[2]:
            continue
        outside = local - np.clip(local, -half, half)
        outside[2] = 0.0
        gap = float(np.linalg.norm(outside))
        if 1e-6 < gap < BESIDE:
            lean += rotation @ outside / gap * MOST_LEAN * min(1.0, 1.6 * (1.0 - gap / BESIDE))
    size = float(np.linalg.norm(lean))
    return lean * min(1.0, MOST_LEAN / size) if size > 0 else lean


def _tall_boxes(hand: Hand, name: str) -> list[tuple[Array, Array, Array]]:
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
                centre, turned = hand.sim.site_pose(asset.regions[region])
                handle, _ = hand.sim.site_pose(articulation.handle_site)
                half = hand.sim.site_half_size(asset.regions[region]) + 0.012
                reach = np.abs(turned.T @ (handle - centre)) + 0.008
                boxes.append((centre, turned, np.maximum(half, reach)))
    return boxes


def _is_rim(hand: Hand, name: str, grasp: Grasp) -> bool:
    return grasp.symmetric and hand.sim.assets[name].clear_radius > 0 and abs(grasp.position[0]) > 0.02


def _choose_grasp(hand: Hand, name: str, attempt: int, avoid: Array | None) -> tuple[Grasp, float]:
    """Pick one of an object's grasps, turned where that is free: easy for the wrist, clear of its neighbours."""
    asset = hand.sim.assets[name]
    if not asset.grasps:
        raise MemobenchError(f"the expert does not know how to hold {name!r}: class {asset.class_name} declares no grasp")
    options: list[tuple[float, Grasp, float]] = []
    here, start = hand.sim.eef_pose()
    for grasp in asset.grasps:
        spins = np.arange(0.0, 2 * np.pi, np.pi / 12) if grasp.symmetric else [0.0]
        for spin in spins:
            target, turn = _grasp_pose(hand, name, grasp, float(spin), FULLY_OPEN)
            wrist = float(np.linalg.norm(Rotation.from_matrix(turn @ start.T).as_rotvec()))
            cost = 0.3 * wrist + float(np.linalg.norm(target - here)) + _crowding(hand, name, target, turn)
            if avoid is not None:
                cost += 2.0 * abs(float(turn[:, 0] @ avoid))
            cost += 3.0 * abs(float(turn[:, 0] @ _lean(hand, name, target)))
            options.append((cost, grasp, float(spin)))
    options.sort(key=lambda option: option[0])
    # A later attempt tries the next different way; each varies a little between episodes.
    rank = min(attempt * max(1, len(options) // 6), len(options) - 1)
    _, grasp, spin = options[rank]
    if grasp.symmetric:
        spin += float(hand.rng.uniform(-0.1, 0.1))
    return grasp, spin


def _crowding(hand: Hand, name: str, target: Array, turn: Array) -> float:
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
            local = rotation.T @ (target + side * apart * turn[:, 0] - position)
            if asset.round:
                gap = float(np.hypot(local[0], local[1])) - asset.radius
            else:
                outside = np.maximum(np.abs(local[:2]) - np.asarray(asset.half_extents), 0.0)
                gap = float(np.hypot(*outside))
            penalty += 40.0 * max(0.0, FINGER_THICKNESS - gap)
    return penalty


def pick(hand: Hand, name: str, avoid: Array | None = None) -> Generator[NDArray[np.float32], None, Held | None]:
    """Take an object from above and lift it; try other grasps when one misses.

    Args:
        hand: the arm.
        name: the object.
        avoid: horizontal direction (3,) along which the fingers should not close, for the place it is brought to.

    Returns:
        How it is held, or None when every attempt missed.
    """
    for attempt in range(ATTEMPTS):
        grasp, spin = _choose_grasp(hand, name, attempt, avoid)

        def above(grasp: Grasp = grasp, spin: float = spin) -> Array:
            return _grasp_pose(hand, name, grasp, spin)[0] + HOVER * UP

        def at(grasp: Grasp = grasp, spin: float = spin) -> Array:
            return _grasp_pose(hand, name, grasp, spin)[0]

        def turned(grasp: Grasp = grasp, spin: float = spin) -> Array:
            return _grasp_pose(hand, name, grasp, spin)[1]

        yield from _rise(hand, OPEN)
        yield from hand.move(above, turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
        yield from hand.move(at, turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)

        def closing(grasp: Grasp = grasp, spin: float = spin) -> Array:
            opening = max(hand.sim.gripper_opening() - CLOSING_LEAD, grasp.width)
            return _grasp_pose(hand, name, grasp, spin, opening)[0]

        yield from hand.close(closing, hand.rotation)
        start, _ = hand.sim.body_pose(name)
        # Back along the fingers: straight up where the hand hangs down, away from what it leans away from.
        lifted = hand.position - LIFT * hand.rotation[:, 2]
        yield from hand.move(lifted, hand.rotation, CLOSED, tolerance=0.02, speed=0.7, timeout=60)
        now, turn = hand.sim.body_pose(name)
        if hand.sim.gripper_opening() > EMPTY and now[2] - start[2] > LIFT * 0.5:
            position, rotation = hand.sim.eef_pose()
            return Held(name, rotation.T @ (now - position), rotation.T @ turn)
        yield from hand.wait(4, OPEN)
    return None


def _rise(hand: Hand, gripper: float, least: float = 0.12) -> Generator[NDArray[np.float32], None, None]:
    """Go straight up to a height over the table at which nothing is in the way."""
    position, rotation = hand.sim.eef_pose()
    height = TABLE_TOP + least
    if position[2] < height:
        target = np.array([position[0], position[1], height])
        yield from hand.move(target, rotation, gripper, tolerance=0.02, turn_tolerance=1.0, timeout=60)


def _holding(hand: Hand, held: Held) -> bool:
    position, rotation = hand.sim.eef_pose()
    now, _ = hand.sim.body_pose(held.name)
    return float(np.linalg.norm(rotation.T @ (now - position) - held.offset)) < LOST


def carry(
    hand: Hand, held: Held, destination: Callable[[], Array], turn: Array, clearance: float, tolerance: float = 0.006
) -> Doing:
    """Bring the held thing's origin over a destination (3,) and down to it; stop early when it was lost.

    Args:
        hand: the arm.
        held: what is carried.
        destination: where the thing's origin shall be, asked anew at every step.
        turn: rotation (3, 3) of the hand on arrival.
        clearance: height over the destination at which the way goes, m.
        tolerance: how near the origin must come, m.
    """

    def hand_at(height: float) -> Callable[[], Array]:
        def target() -> Array:
            # Where the thing really is in the hand, not where it was when grasped: it may have turned or slipped.
            position, rotation = hand.sim.eef_pose()
            now, _ = hand.sim.body_pose(held.name)
            offset = turn @ rotation.T @ (now - position)
            return destination() - offset + height * UP

        return target

    def lost() -> bool:
        return not _holding(hand, held)

    position, rotation = hand.sim.eef_pose()
    high = max(float(position[2]), float(hand_at(clearance)()[2]))
    up = np.array([position[0], position[1], high])
    yield from hand.move(up, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=60, give_up=lost)

    def over() -> Array:
        target = hand_at(clearance)()
        return np.array([target[0], target[1], max(target[2], high - 0.02)])

    yield from hand.move(over, turn, CLOSED, tolerance=0.012, turn_tolerance=0.08, give_up=lost)
    yield from hand.move(hand_at(clearance), turn, CLOSED, tolerance=0.012, timeout=60, give_up=lost)
    if lost():
        return False
    yield from hand.lower(hand_at(0.0), turn, CLOSED, tolerance=tolerance)
    return _holding(hand, held)


def release(hand: Hand, up: float = 0.12) -> Generator[NDArray[np.float32], None, None]:
    """Open the fingers and go up.

    The hand rises while the fingers still open: fully open inside a bowl they would press against its wall and take
    it along.
    """
    yield from hand.wait(3, OPEN)
    target = hand.position + up * UP
    yield from hand.move(target, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, speed=0.7, timeout=60)


def put_on(hand: Hand, held: Held, support: str) -> Doing:
    """Set the held thing down on the middle of another object."""
    asset, below = hand.sim.assets[held.name], hand.sim.assets[support]
    # What is too long for a bowl's floor comes to rest on its wall, near the rim.
    height = below.supports if asset.radius <= below.clear_radius else below.top - 0.012
    turn = hand.rotation

    def destination() -> Array:
        position, rotation = hand.sim.body_pose(support)
        _, tilt = hand.sim.body_pose(held.name)
        drop = -asset.bottom if tilt[2, 2] > 0.9 else asset.radius * 0.6
        return position + rotation @ np.array([0.0, 0.0, height]) + (drop + 0.008) * UP

    arrived = yield from carry(hand, held, destination, turn, clearance=max(0.08, below.top - height + 0.06))
    yield from release(hand)
    return arrived


def put_on_region(hand: Hand, held: Held, position: Array) -> Doing:
    """Set the held thing down with its origin over a place (3,) of a level surface."""
    asset = hand.sim.assets[held.name]
    arrived = yield from carry(
        hand, held, lambda: position + (0.006 - asset.bottom) * UP, hand.rotation, clearance=0.10, tolerance=0.008
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
    turn = frame(DOWN, np.cross(UP, outward))

    def destination() -> Array:
        centre, _ = hand.sim.site_pose(region)
        return centre + 0.015 * outward + (half[2] - asset.bottom - 0.005) * UP - 0.02 * UP

    arrived = yield from carry(hand, held, destination, turn, clearance=0.12, tolerance=0.012)
    yield from release(hand)
    return arrived


def outward_of(hand: Hand, articulation: Articulation) -> Array:
    """Return the horizontal direction (3,) in which a drawer opens."""
    axis = hand.sim.data.joint(articulation.joint).xaxis * np.sign(articulation.open_q - articulation.closed_q)
    outward = axis * np.array([1.0, 1.0, 0.0])
    return outward / np.linalg.norm(outward)


def _at_handle(hand: Hand, articulation: Articulation, tilt: float) -> tuple[Array, Array, Array]:
    """Return a handle's position, the direction back along the fingers, and the hand's rotation to hold it.

    The fingers close level, along the front: the hand is 20 cm wide that way and thin the other, so that it neither
    touches the table under the lowest drawer nor the handle above.
    """
    position, _ = hand.sim.site_pose(articulation.handle_site)
    out = outward_of(hand, articulation)
    back = np.cos(tilt) * out + np.sin(tilt) * UP
    return position, back, frame(-back, np.cross(UP, out))


TILT = np.radians(35)
"""How far the hand points down when it takes a handle: enough for the flange to clear the table."""


def open_drawer(hand: Hand, region: str) -> Doing:
    """Take a drawer's handle and pull until the drawer counts as open."""
    articulation, _ = hand.sim.world.articulation(region)
    assert articulation.open_below is not None
    tilt = TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)

        def at(back: float, tilt: float = tilt) -> Callable[[], Array]:
            def target() -> Array:
                position, direction, _ = _at_handle(hand, articulation, tilt)
                return position + back * direction

            return target

        def turned(tilt: float = tilt) -> Array:
            return _at_handle(hand, articulation, tilt)[2]

        yield from _rise(hand, OPEN, 0.16)
        yield from hand.move(at(0.14), turned, OPEN, tolerance=0.03, turn_tolerance=0.15)
        yield from hand.move(at(0.07), turned, OPEN, tolerance=0.012, turn_tolerance=0.06)
        yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
        yield from hand.close()
        rotation = turned()
        for _ in range(90):
            _, q = hand.sim.world.articulation(region)
            if q < articulation.open_below - 0.006:
                break
            handle, _ = hand.sim.site_pose(articulation.handle_site)
            if float(np.linalg.norm(hand.position - handle)) > LOST:
                break
            yield hand.toward(handle + 0.035 * out, rotation, CLOSED, speed=0.8)
        yield from hand.wait(6, OPEN)
        yield from hand.move(at(0.09), rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        _, q = hand.sim.world.articulation(region)
        if q < articulation.open_below:
            return True
    return False


def close_drawer(hand: Hand, region: str) -> Doing:
    """Push an open drawer shut with closed fingers on its handle."""
    articulation, _ = hand.sim.world.articulation(region)
    assert articulation.closed_above is not None
    tilt = TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)
        rotation = _at_handle(hand, articulation, tilt)[2]

        def before(gap: float, out: Array = out) -> Callable[[], Array]:
            return lambda: hand.sim.site_pose(articulation.handle_site)[0] + gap * out

        yield from _rise(hand, CLOSED, 0.2)
        yield from hand.move(lambda: before(0.10)() + 0.06 * UP, rotation, CLOSED, tolerance=0.03, turn_tolerance=0.15)
        yield from hand.move(before(0.06), rotation, CLOSED, tolerance=0.015, turn_tolerance=0.08)
        for _ in range(110):
            _, q = hand.sim.world.articulation(region)
            if q > articulation.closed_above + 0.003:
                break
            handle, _ = hand.sim.site_pose(articulation.handle_site)
            gap = hand.position - handle
            if float(np.linalg.norm(gap - (gap @ out) * out)) > 0.04:
                break
            yield hand.toward(handle - 0.03 * out, rotation, CLOSED, speed=0.7)
        yield from hand.move(hand.position + 0.08 * out, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        _, q = hand.sim.world.articulation(region)
        if q > articulation.closed_above:
            return True
    return False


def turn_knob(hand: Hand, name: str, on: bool) -> Doing:
    """Take a knob's ridge from above and turn it until it counts as on, or as off."""
    articulation, _ = hand.sim.world.articulation(name)
    assert articulation.on_at_least is not None and articulation.off_below is not None
    aim = articulation.on_at_least + float(hand.rng.uniform(0.12, 0.25)) if on else articulation.off_below - 0.06

    def reached(q: float) -> bool:
        assert articulation.on_at_least is not None and articulation.off_below is not None
        return q >= articulation.on_at_least + 0.08 if on else q < articulation.off_below - 1e-4

    for _ in range(ATTEMPTS):

        def ridge() -> tuple[Array, Array]:
            position, rotation = hand.sim.site_pose(articulation.handle_site)
            across = rotation[:, 1] * np.array([1.0, 1.0, 0.0])
            return position, downward(float(np.arctan2(across[1], across[0])))

        yield from _rise(hand, OPEN)
        yield from hand.move(lambda: ridge()[0] + HOVER * UP, lambda: ridge()[1], OPEN, tolerance=0.01, turn_tolerance=0.06)
        yield from hand.move(lambda: ridge()[0], lambda: ridge()[1], OPEN, tolerance=0.005, speed=0.6, timeout=60)
        yield from hand.close()
        grip = hand.rotation
        _, start = hand.sim.world.articulation(name)
        for _ in range(100):
            _, q = hand.sim.world.articulation(name)
            if reached(q):
                break
            turned = Rotation.from_matrix(hand.rotation @ grip.T).as_rotvec()[2]
            lead = float(np.clip(aim - start - turned, -0.25, 0.25)) + turned
            goal = Rotation.from_rotvec([0.0, 0.0, lead]).as_matrix() @ grip
            yield hand.toward(ridge()[0], goal, CLOSED)
        yield from hand.wait(6, OPEN)
        yield from hand.move(hand.position + 0.10 * UP, hand.rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        _, q = hand.sim.world.articulation(name)
        if on and q >= articulation.on_at_least or not on and q < articulation.off_below:
            return True
    return False


def go_home(hand: Hand, position: Array, rotation: Array) -> Generator[NDArray[np.float32], None, None]:
    """Rise and go back to a pose with the fingers open."""
    yield from _rise(hand, OPEN, 0.2)
    yield from hand.move(position, rotation, OPEN, tolerance=0.012, turn_tolerance=0.08)
