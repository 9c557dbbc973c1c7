"""Pull and push drawers by their handles, turn knobs."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.grasping import ATTEMPTS, HOVER
from lerobot_memobench.experts.hand import CLOSED, OPEN, UP, Array, Hand, cross, downward, frame, length
from lerobot_memobench.experts.surroundings import outward_of
from lerobot_memobench.experts.travel import LOST, Doing, Steps, let_go, pressed, rise
from lerobot_memobench.sim.assets.asset import Articulation

TILT = np.radians(35)
"""How far the hand points down when it takes a handle: enough for the flange to clear the table."""


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


def open_drawer(hand: Hand, region: str) -> Doing:
    """Take a drawer's handle and pull until the drawer counts as open."""
    articulation, _ = hand.sim.world.articulation(region)
    assert articulation.open_below is not None
    tilt = TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)
        yield from _take_handle(hand, articulation, tilt)
        rotation = _at_handle(hand, articulation, tilt)[2]
        yield from _pull(hand, region, rotation, out)
        yield from hand.open(6)
        back = _off_handle(hand, articulation, tilt, 0.09)
        yield from hand.move(back, rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        _, q = hand.sim.world.articulation(region)
        if q < articulation.open_below:
            return True
    return False


def _take_handle(hand: Hand, articulation: Articulation, tilt: float) -> Steps:
    def turned() -> Array:
        return _at_handle(hand, articulation, tilt)[2]

    def at(back: float) -> Callable[[], Array]:
        return _off_handle(hand, articulation, tilt, back)

    yield from rise(hand, OPEN, 0.16)
    yield from hand.move(at(0.14), turned, OPEN, tolerance=0.03, turn_tolerance=0.15)
    yield from hand.move(at(0.07), turned, OPEN, tolerance=0.012, turn_tolerance=0.06)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()


def _pull(hand: Hand, region: str, rotation: Array, out: Array) -> Steps:
    """Pull a drawer by its handle until it is open, or the handle is lost."""
    for _ in range(90):
        articulation, q = hand.sim.world.articulation(region)
        assert articulation.open_below is not None
        if q < articulation.open_below - 0.006:
            break
        handle, _ = hand.sim.site_pose(articulation.handle_site)
        if hand.empty or length(hand.position - handle) > LOST:
            break
        yield hand.toward(handle + 0.035 * out, rotation, CLOSED, speed=0.8)


def close_drawer(hand: Hand, region: str) -> Doing:
    """Push an open drawer shut with closed fingers on its handle."""
    articulation, _ = hand.sim.world.articulation(region)
    assert articulation.closed_above is not None
    tilt = TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(ATTEMPTS):
        out = outward_of(hand, articulation)
        rotation = _at_handle(hand, articulation, tilt)[2]
        yield from _come_before(hand, articulation, rotation, out)
        yield from _push(hand, region, rotation, out)
        back = hand.position + 0.08 * out
        yield from hand.move(back, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        _, q = hand.sim.world.articulation(region)
        if q > articulation.closed_above:
            return True
    return False


def _come_before(hand: Hand, articulation: Articulation, rotation: Array, out: Array) -> Steps:
    """Bring the closed fingers in front of a handle, from above."""

    def before(gap: float) -> Array:
        return hand.sim.site_pose(articulation.handle_site)[0] + gap * out

    yield from rise(hand, CLOSED, 0.2)
    high = before(0.10) + 0.06 * UP
    yield from hand.move(high, rotation, CLOSED, tolerance=0.03, turn_tolerance=0.15)
    yield from hand.move(lambda: before(0.06), rotation, CLOSED, tolerance=0.015, turn_tolerance=0.08)


def _push(hand: Hand, region: str, rotation: Array, out: Array) -> Steps:
    """Push a drawer by its handle until it is shut, or the fingers slip off sideways."""
    articulation, _ = hand.sim.world.articulation(region)
    closed_above = articulation.closed_above
    assert closed_above is not None
    shut = pressed(lambda: hand.sim.world.articulation(region)[1] > closed_above + 0.003)
    for _ in range(110):
        if shut():
            break
        handle, _ = hand.sim.site_pose(articulation.handle_site)
        gap = hand.position - handle
        if length(gap - (gap @ out) * out) > 0.04:
            break
        yield hand.toward(handle - 0.03 * out, rotation, CLOSED, speed=0.7)


def turn_knob(hand: Hand, name: str, on: bool) -> Doing:
    """Take a knob's ridge from above and turn it until it counts as on, or as off."""
    articulation, _ = hand.sim.world.articulation(name)
    on_from, off_to = articulation.on_at_least, articulation.off_below
    assert on_from is not None
    assert off_to is not None
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
            return True
    return False


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
        angle = float(Rotation.from_matrix(hand.rotation @ grip.T).as_rotvec()[2])
        lead = float(np.clip(aim - start - angle, -0.25, 0.25)) + angle
        goal = Rotation.from_rotvec([0.0, 0.0, lead]).as_matrix() @ grip
        yield hand.toward(_ridge(hand, articulation)[0], goal, CLOSED)
