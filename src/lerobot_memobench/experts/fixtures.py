"""Operate fixtures: pull and push drawers, turn knobs, open and close hinged doors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.grasping import HOVER_HEIGHT, MAX_ATTEMPTS
from lerobot_memobench.experts.hand import (
    CLOSED,
    DOWN,
    MAX_STRETCH,
    NEUTRAL_CLOSING,
    OPEN,
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
    DROP_DISTANCE,
    OPEN_WIDTH,
    distance_from_base,
    hand_penetration,
    leaned_rotation,
    opening_direction,
    reach_lean,
    release_fixture,
    rise,
    sustained,
)
from lerobot_memobench.sim.asset import Articulation

HANDLE_TILT = np.radians(35)  # downward tilt of the hand at a handle: the flange clears the table, rad
WIDE_HANDLE_ROLL, WIDE_HANDLE_TILT = np.radians(30), np.radians(27)
"""Roll and downward tilt of the hand at a bar that is longer than the open fingers, rad. With more roll or less tilt
the hand touches the table below the lowest drawer, stays above the bar and slips off; with more tilt it touches the
handle above; with less roll the bar does not fit between the fingers."""
HANDLE_APPROACH, HANDLE_MARGIN = (0.14, 0.07, 0.0), 0.03
"""Distances of the open fingers from a handle on the way to it, and the margin between the hand, which turns on this
way, and objects in front of the handle, m."""
DOWNWARD_REACH = 0.72  # distance from the arm's base up to which a downward hand moves freely, m
DOOR_THICKNESS = 0.02
DOOR_EDGE_INSET, DOOR_EDGE_DEPTH = 0.012, 0.018
"""Grasp on a door's upper edge: distance from the handle towards the hinge, and depth, m."""
SWING_LEAD = 0.13  # angle by which the hand leads a door along its arc, rad
SWING_END_LEAD = 0.04  # lead at the end of the swing, rad; a faster hand would throw the door out of reach
FREE_SWING_END_LEAD = 0.015  # lead at the end of the swing of a door without friction, rad
PUSH_GAP = 0.06  # distance of the closed fingers in front of a handle before pushing, m
PUSH_SIDES = (0.0, 0.02, -0.02, 0.04, -0.04, 0.06, -0.06)
"""Displacements along a handle at which a drawer is pushed, in the order of preference, m."""
HANDLE_GRIP_DEPTH = 0.018  # depth of the grasp below a handle's upper end, m

SWEEP_LEAD = 0.16  # angle by which the hand leads a door in one sweep, rad
PANEL_PUSH_INSET, PANEL_PUSH_DEPTH = 0.045, 0.030
"""Contact point for pushing a door: distance from the handle towards the hinge, and depth below the upper edge, m."""
PANEL_APPROACH_GAP, PANEL_CONTACT_GAP = 0.06, 0.018
"""Distance of the hand from the panel's centre plane before and during the push, m."""
MAX_SWEEP_STEPS = 150  # maximum number of control steps of a sweep


def _joint_position(hand: Hand, name: str) -> float:
    return hand.sim.world.articulation(name)[1]


def _closing_sign(direction: Array) -> float:
    """Return the sign that turns a closing direction (3,) towards the neutral one of the last joint."""
    return float(np.sign(direction @ NEUTRAL_CLOSING) or 1.0)


# --- drawers and knobs ---


@dataclass(frozen=True)
class _HandleGrip:
    """Pose of the hand at a drawer's handle.

    The fingers close horizontally along the front. The hand is 20 cm wide in that direction and thin in the other, so
    it touches neither the table below the lowest drawer nor the handle above.
    """

    hand: Hand
    articulation: Articulation
    tilt: float  # downward tilt, rad
    roll: float = 0.0  # roll about the fingers, rad

    def pose(self, back: float = 0.0) -> tuple[Array, Array]:
        """Return the position (3,) at a distance back from the handle along the fingers, m, and the rotation (3, 3)."""
        position, _ = self.hand.sim.site_pose(self.articulation.handle_site)
        out = opening_direction(self.hand, self.articulation)
        direction = np.cos(self.tilt) * out + np.sin(self.tilt) * UP
        rotation = frame(-direction, cross(UP, out))
        if self.roll:
            rotation = Rotation.from_rotvec(self.roll * direction).as_matrix() @ rotation
        return position + back * direction, rotation

    def at(self, back: float) -> Callable[[], Array]:
        return lambda: self.pose(back)[0]

    def turned(self) -> Array:
        return self.pose()[1]

    def collision(self) -> float:
        """Return the largest penetration of other objects on the way to the handle, m."""
        poses = (self.pose(back) for back in HANDLE_APPROACH)
        return max(hand_penetration(self.hand, "", *pose, HANDLE_MARGIN) for pose in poses)


def open_drawer(hand: Hand, region: str) -> Steps:
    """Grasp a drawer's handle and pull until the drawer counts as open."""
    articulation, _ = hand.sim.world.articulation(region)
    long = articulation.handle_size[0] >= OPEN_WIDTH  # a bar that fits between the fingers only diagonally
    tilt = (WIDE_HANDLE_TILT if long else HANDLE_TILT) + float(hand.rng.uniform(-0.06, 0.06))
    rolls = (WIDE_HANDLE_ROLL, -WIDE_HANDLE_ROLL) if long else (0.0,)
    for _ in range(MAX_ATTEMPTS):
        out = opening_direction(hand, articulation)
        grips = [_HandleGrip(hand, articulation, tilt, roll) for roll in rolls]
        grip = min(grips if hand.strict else grips[:1], key=_HandleGrip.collision)
        far, near, at = map(grip.at, HANDLE_APPROACH)
        yield from rise(hand, OPEN, 0.16)
        yield from hand.move(far, grip.turned, OPEN, tolerance=0.03, turn_tolerance=0.15)
        yield from hand.move(near, grip.turned, OPEN, tolerance=0.012, turn_tolerance=0.06)
        yield from hand.move(at, grip.turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
        yield from hand.close()
        rotation = grip.turned()
        yield from _pull_drawer(hand, region, rotation, out)
        yield from hand.open(6)
        yield from hand.move(grip.at(0.09), rotation, OPEN, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        if _joint_position(hand, region) < articulation.open_below:
            return


def _pull_drawer(hand: Hand, region: str, rotation: Array, out: Array) -> Steps:
    for _ in range(90):
        articulation, q = hand.sim.world.articulation(region)
        if q < articulation.open_below - 0.006:
            break
        handle, _ = hand.sim.site_pose(articulation.handle_site)
        if hand.empty or length(hand.position - handle) > DROP_DISTANCE:
            break
        yield hand.toward(handle + 0.035 * out, rotation, CLOSED, speed=0.8)


def close_drawer(hand: Hand, region: str) -> Steps:
    """Close a drawer with closed fingers on its handle."""
    articulation, _ = hand.sim.world.articulation(region)
    tilt = HANDLE_TILT + float(hand.rng.uniform(-0.06, 0.06))
    for _ in range(MAX_ATTEMPTS):
        out = opening_direction(hand, articulation)
        rotation = _HandleGrip(hand, articulation, tilt).turned()
        aside = _free_side(hand, articulation, rotation, out)
        yield from _approach_handle(hand, articulation, rotation, out, aside)
        yield from _push_drawer(hand, region, rotation, out, aside)
        back = hand.position + 0.08 * out
        yield from hand.move(back, rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=50)
        if _joint_position(hand, region) > articulation.closed_above:
            return


def _free_side(hand: Hand, articulation: Articulation, rotation: Array, out: Array) -> Array:
    # The hand is 20 cm wide along the handle.
    handle, _ = hand.sim.site_pose(articulation.handle_site)

    def collision(aside: float) -> float:
        return hand_penetration(hand, "", handle + PUSH_GAP * out + aside * rotation[:, 0], rotation, HANDLE_MARGIN)

    return min(PUSH_SIDES if hand.strict else PUSH_SIDES[:1], key=collision) * rotation[:, 0]


def _approach_handle(hand: Hand, articulation: Articulation, rotation: Array, out: Array, aside: Array) -> Steps:
    def before(gap: float) -> Array:
        return hand.sim.site_pose(articulation.handle_site)[0] + gap * out + aside

    yield from rise(hand, CLOSED, 0.2)
    high = before(0.10) + 0.06 * UP
    yield from hand.move(high, rotation, CLOSED, tolerance=0.03, turn_tolerance=0.15)
    yield from hand.move(lambda: before(PUSH_GAP), rotation, CLOSED, tolerance=0.015, turn_tolerance=0.08)


def _push_drawer(hand: Hand, region: str, rotation: Array, out: Array, aside: Array) -> Steps:
    articulation, _ = hand.sim.world.articulation(region)
    spare = min(0.003, articulation.closed_q - articulation.closed_above)
    shut = sustained(lambda: _joint_position(hand, region) > articulation.closed_above + spare)
    for _ in range(110):
        if shut():
            break
        handle = hand.sim.site_pose(articulation.handle_site)[0] + aside
        gap = hand.position - handle
        if length(gap - (gap @ out) * out) > 0.04:
            break
        yield hand.toward(handle - 0.03 * out, rotation, CLOSED, speed=0.7)


def turn_knob(hand: Hand, name: str, on: bool) -> Steps:
    """Grasp a knob's ridge from above and turn it until it counts as on or off."""
    articulation, _ = hand.sim.world.articulation(name)
    on_from, off_to = articulation.on_at_least, articulation.off_below
    aim = on_from + float(hand.rng.uniform(0.12, 0.25)) if on else off_to - 0.15

    def reached(spare: float) -> bool:
        q = _joint_position(hand, name)
        return q >= on_from + spare if on else q < off_to - min(spare, 1e-4)

    for _ in range(MAX_ATTEMPTS):
        yield from _take_ridge(hand, articulation)
        turned = partial(reached, 0.08)
        yield from _twist(hand, name, aim, turned if on else sustained(turned))
        yield from release_fixture(hand, 0.10)
        if reached(0.0):
            return


def _take_ridge(hand: Hand, articulation: Articulation) -> Steps:
    def at(height: float) -> Callable[[], Array]:
        return lambda: hand.sim.site_pose(articulation.handle_site)[0] + height * UP

    def turned() -> Array:
        across = hand.sim.site_pose(articulation.handle_site)[1][:, 1] * np.array([1.0, 1.0, 0.0])
        return downward(float(np.arctan2(across[1], across[0])))

    yield from rise(hand, OPEN)
    yield from hand.move(at(HOVER_HEIGHT), turned, OPEN, tolerance=0.01, turn_tolerance=0.06)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()


def _twist(hand: Hand, name: str, aim: float, reached: Callable[[], bool]) -> Steps:
    grip = hand.rotation
    articulation, start = hand.sim.world.articulation(name)
    for _ in range(100):
        if reached() or hand.empty:
            break
        angle = float(rotation_vector(hand.rotation @ grip.T)[2])
        lead = float(np.clip(aim - start - angle, -0.25, 0.25)) + angle
        goal = Rotation.from_rotvec([0.0, 0.0, lead]).as_matrix() @ grip
        yield hand.toward(hand.sim.site_pose(articulation.handle_site)[0], goal, CLOSED)


# --- doors ---


@dataclass(frozen=True)
class Door:
    """Present geometry of a hinged door. Directions are horizontal unit vectors (3,), positions are (3,), m."""

    q: float
    handle: Array
    outward: Array  # normal of the door's front
    along: Array  # direction from the hinge to the free edge
    edge: Array  # point on the upper edge near the handle, at the panel's centre plane


def door_geometry(hand: Hand, name: str, ahead: float = 0.0) -> Door:
    """Return a door's geometry, rotated about its hinge by ``ahead``, rad."""
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
    depth = articulation.clearance + articulation.handle_size[1] / 2 + DOOR_THICKNESS / 2
    edge = handle - depth * outward - DOOR_EDGE_INSET * along
    edge[2] = hand.sim.asset_pose(name)[0][2] + hand.sim.assets[name].top
    turned = Rotation.from_rotvec(joint.xaxis * ahead).apply
    handle, edge = hinge + turned(lever), hinge + turned(edge - hinge)
    return Door(q + ahead, handle, turned(outward), turned(along), edge)


def door_is_at_goal(hand: Hand, name: str, opening: bool) -> bool:
    """Return whether a door is open, or closed, with a margin."""
    articulation, q = hand.sim.world.articulation(name)
    return q < articulation.open_below - 0.015 if opening else q > articulation.closed_above + 0.002


def open_door(hand: Hand, name: str) -> Steps:
    """Pull a door by its handle within the arm's comfortable reach, then swing it by its upper edge."""
    articulation, _ = hand.sim.world.articulation(name)
    for _ in range(MAX_ATTEMPTS):
        if distance_from_base(door_geometry(hand, name).handle) < DOWNWARD_REACH:
            yield from _pull_door(hand, name)
        if _joint_position(hand, name) >= articulation.open_below:
            yield from _swing_door(hand, name, opening=True)
        if _joint_position(hand, name) < articulation.open_below:
            return


def close_door(hand: Hand, name: str) -> Steps:
    """Swing a door by its upper edge until its handle is in reach, then push the handle."""
    articulation, _ = hand.sim.world.articulation(name)
    for _ in range(MAX_ATTEMPTS):
        door = door_geometry(hand, name)
        if distance_from_base(door.handle + PUSH_GAP * door.outward) > DOWNWARD_REACH:
            yield from _swing_door(hand, name, opening=False)
        yield from _push_door(hand, name)
        if _joint_position(hand, name) > articulation.closed_above:
            return


def _pull_door(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    up = (articulation.handle_size[0] / 2 - HANDLE_GRIP_DEPTH) * UP
    flip = _closing_sign(door_geometry(hand, name).along)

    def at(height: float, ahead: float = 0.0) -> Callable[[], Array]:
        return lambda: door_geometry(hand, name, ahead).handle + up + height * UP

    def turned(ahead: float = 0.0) -> Array:
        return frame(DOWN, flip * door_geometry(hand, name, ahead).along)

    yield from rise(hand, OPEN, 0.26)
    yield from hand.move(at(HOVER_HEIGHT + 0.02), turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
    yield from hand.move(at(0.0), turned, OPEN, tolerance=0.005, speed=0.6, timeout=60)
    yield from hand.close()
    way = np.sign(articulation.open_q - articulation.closed_q)
    for _ in range(160):
        door = door_geometry(hand, name)
        if door_is_at_goal(hand, name, opening=True) or distance_from_base(door.handle) > DOWNWARD_REACH:
            break
        if hand.empty or length(hand.position - door.handle - up) > DROP_DISTANCE:
            break
        yield hand.toward(at(0.0, way * SWING_LEAD)(), turned(way * SWING_LEAD / 2), CLOSED, speed=0.8)
    yield from release_fixture(hand)


def _swing_door(hand: Hand, name: str, opening: bool) -> Steps:
    articulation, start = hand.sim.world.articulation(name)
    goal = articulation.open_below if opening else articulation.closed_q
    way = float(np.sign(goal - start))
    free = hand.sim.model.joint(articulation.joint).frictionloss[0] == 0.0
    # A door without friction opens wider: lean during the descent, too.
    end_lead, over = (FREE_SWING_END_LEAD, HOVER_HEIGHT) if free else (SWING_END_LEAD, 0.0)
    flip = _closing_sign(door_geometry(hand, name, (goal - start) / 2).outward)

    def turned(ahead: float = 0.0) -> Array:
        # A wide-open door is out of reach of an upright hand: the fingers point outwards.
        door = door_geometry(hand, name, ahead)
        return leaned_rotation(flip * door.outward, reach_lean(hand, door.edge + over * UP, MAX_STRETCH))

    def at(back: float, ahead: float = 0.0) -> Callable[[], Array]:
        return lambda: door_geometry(hand, name, ahead).edge - back * turned(ahead)[:, 2]

    yield from rise(hand, OPEN, 0.26)
    yield from hand.move(at(HOVER_HEIGHT), turned, OPEN, tolerance=0.012, turn_tolerance=0.08)
    yield from hand.move(at(-DOOR_EDGE_DEPTH), turned, OPEN, tolerance=0.006, speed=0.6, timeout=60)
    yield from hand.close()
    for _ in range(160):
        door = door_geometry(hand, name)
        if _swing_is_over(hand, name, door, opening):
            break
        lead = way * min(SWING_LEAD, abs(goal - door.q) + end_lead)
        yield hand.toward(at(-DOOR_EDGE_DEPTH, lead)(), turned(lead / 2), CLOSED, speed=0.8)
    yield from release_fixture(hand)


def _swing_is_over(hand: Hand, name: str, door: Door, opening: bool) -> bool:
    if door_is_at_goal(hand, name, opening):
        return True
    if not opening and distance_from_base(door.handle + PUSH_GAP * door.outward) < DOWNWARD_REACH - 0.04:
        return True
    return hand.empty or length(hand.position - door.edge) > DROP_DISTANCE + DOOR_EDGE_DEPTH


def _push_door(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    way = float(np.sign(articulation.closed_q - articulation.open_q))
    flip = _closing_sign(door_geometry(hand, name).along)

    def at(gap: float, height: float = 0.0, ahead: float = 0.0) -> Array:
        door = door_geometry(hand, name, ahead)
        return door.handle + gap * door.outward + height * UP

    def turned(ahead: float = 0.0) -> Array:
        return frame(DOWN, flip * door_geometry(hand, name, ahead).along)

    yield from rise(hand, CLOSED, 0.26)
    yield from hand.move(lambda: at(PUSH_GAP, 0.15), turned, CLOSED, tolerance=0.02, turn_tolerance=0.1)
    yield from hand.move(lambda: at(PUSH_GAP), turned, CLOSED, tolerance=0.012, turn_tolerance=0.1)
    shut = sustained(lambda: door_is_at_goal(hand, name, opening=False))
    for _ in range(160):
        if shut():
            break
        door = door_geometry(hand, name)
        if abs(float((hand.position - door.handle) @ door.along)) > 0.04:
            break
        yield hand.toward(at(0.01, 0.0, way * SWING_LEAD), turned(), CLOSED, speed=0.8)
    back = hand.position + 0.06 * door_geometry(hand, name).outward
    yield from hand.move(back, hand.rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=40)
    yield from rise(hand, CLOSED, 0.26)


# --- doors in one sweep, for counting tasks: half the steps of `open_door` and `close_door`. The hand leans as far as
# the door moves; in the published demonstrations it releases the door and grasps it again ---


def sweep_door(hand: Hand, name: str, opening: bool) -> Steps:
    """Grasp a door's handle and follow the arc until the door is open, or push its panel until it is closed."""
    for _ in range(MAX_ATTEMPTS):
        yield from (_sweep_open if opening else _sweep_shut)(hand, name)
        if door_is_at_goal(hand, name, opening):
            return


def _sweep_rotation(hand: Hand, door: Door, position: Array, flip: float) -> Array:
    closing = flip * door.along
    lean = reach_lean(hand, position)
    return leaned_rotation(closing, lean - (lean @ closing) * closing)


def _sweep_open(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    up = (articulation.handle_size[0] / 2 - HANDLE_GRIP_DEPTH) * UP
    flip = _closing_sign(door_geometry(hand, name).along)

    def grip(ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_geometry(hand, name, ahead)
        return door.handle + up, _sweep_rotation(hand, door, door.handle + up, flip)

    def over() -> Array:
        return grip()[0] - HOVER_HEIGHT * grip()[1][:, 2]

    yield from hand.move(over, lambda: grip()[1], OPEN, tolerance=0.02, turn_tolerance=0.1)
    yield from hand.move(lambda: grip()[0], lambda: grip()[1], OPEN, tolerance=0.006, speed=0.8, timeout=60)
    yield from hand.close()
    way = np.sign(articulation.open_q - articulation.closed_q)
    for _ in range(MAX_SWEEP_STEPS):
        if door_is_at_goal(hand, name, opening=True) or length(hand.position - grip()[0]) > DROP_DISTANCE:
            break
        yield hand.toward(*grip(way * SWEEP_LEAD), CLOSED)
    yield from release_fixture(hand, 0.08)


def _sweep_shut(hand: Hand, name: str) -> Steps:
    articulation, _ = hand.sim.world.articulation(name)
    way = float(np.sign(articulation.closed_q - articulation.open_q))
    flip = _closing_sign(door_geometry(hand, name).along)

    def pose(gap: float, height: float = 0.0, ahead: float = 0.0) -> tuple[Array, Array]:
        door = door_geometry(hand, name, ahead)
        position = door.edge - PANEL_PUSH_INSET * door.along + gap * door.outward + (height - PANEL_PUSH_DEPTH) * UP
        return position, _sweep_rotation(hand, door, position, flip)

    yield from rise(hand, CLOSED, 0.26)
    for height, tolerance in ((0.12, 0.03), (0.0, 0.02)):
        target, turn = pose(PANEL_APPROACH_GAP, height)
        yield from hand.move(target, turn, CLOSED, tolerance=tolerance, turn_tolerance=0.15)
    shut = sustained(lambda: door_is_at_goal(hand, name, opening=False))
    for _ in range(MAX_SWEEP_STEPS):
        if shut() or length(hand.position - pose(PANEL_CONTACT_GAP)[0]) > DROP_DISTANCE + PANEL_APPROACH_GAP:
            break
        yield hand.toward(*pose(PANEL_CONTACT_GAP, 0.0, way * SWEEP_LEAD), CLOSED)
    back = hand.position + 0.05 * door_geometry(hand, name).outward
    yield from hand.move(back, hand.rotation, CLOSED, tolerance=0.02, turn_tolerance=1.0, timeout=40)
