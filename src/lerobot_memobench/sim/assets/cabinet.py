"""Build the wooden cabinet with three drawers that open towards local -y."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mujoco

from lerobot_memobench.sim.assets.asset import Articulation, Asset, Handle
from lerobot_memobench.sim.assets.builder import GRIP_FRICTION, Builder
from lerobot_memobench.sim.assets.meshes import Block, blocks
from lerobot_memobench.sim.assets.paint import wood

DRAWER_RANGE = (-0.16, 0.01)
CLOSED = 0.005
OPEN = -0.155
LEVELS = ("bottom", "middle", "top")

_HALF_X = 0.1265
_FRONT, _BACK = -0.070, 0.110  # y; the drawers' fronts are flush with _FRONT at q = CLOSED
_HIGH = 0.218
_BOARD = 0.006
_SIDE = 0.008
_SHELF = 0.004
_OPENING = (_HIGH - 2 * _BOARD - 2 * _SHELF) / 3
_PITCH = _OPENING + _SHELF

# A drawer in the frame of its body: the cabinet's frame at q = 0, with z = 0 at the drawer's underside.
_HALF_DRAWER_X = _HALF_X - _SIDE - 0.0015
_FACE = _FRONT - CLOSED  # y of the front's outer face at q = 0
_PANEL = 0.008
_WALL = 0.005
_FLOOR = 0.003
_WALL_HIGH = 0.050
_INNER_FRONT = _FACE + _PANEL
_INNER_BACK = _INNER_FRONT + 0.150
_DRAWER_HIGH = _OPENING - 0.003

_HANDLE_LENGTH = 0.056
_HANDLE_THICK = 0.012
_HANDLE_OUT = 0.038


def _carcass() -> list[Block]:
    middle, depth = (_FRONT + _BACK) / 2, (_BACK - _FRONT) / 2
    inner = _HALF_X - _SIDE
    parts = [
        Block((s * (_HALF_X - _SIDE / 2), middle, _HIGH / 2), (_SIDE / 2, depth, _HIGH / 2), 1) for s in (-1.0, 1.0)
    ]
    parts += [
        Block((0, middle, _BOARD / 2), (inner, depth, _BOARD / 2), 0),
        Block((0, middle, _HIGH - _BOARD / 2), (inner, depth, _BOARD / 2), 0),
        Block((0, _BACK - _BOARD / 2, _HIGH / 2), (inner, _BOARD / 2, _HIGH / 2 - _BOARD), 0),
    ]
    for k in (1, 2):
        z = _BOARD + k * _PITCH - _SHELF / 2
        parts.append(Block((0, middle - _BOARD / 2, z), (inner, depth - _BOARD / 2, _SHELF / 2), 0))
    return parts


def _box() -> list[Block]:
    """Return floor, sides and back of a drawer; its underside is z = 0."""
    middle, depth = (_INNER_FRONT + _INNER_BACK) / 2, (_INNER_BACK - _INNER_FRONT) / 2
    x = _HALF_DRAWER_X
    high = _WALL_HIGH / 2
    return [
        Block((0, middle, _FLOOR / 2), (x, depth, _FLOOR / 2), 1),
        Block((-x + _WALL / 2, middle, high), (_WALL / 2, depth, high), 1),
        Block((x - _WALL / 2, middle, high), (_WALL / 2, depth, high), 1),
        Block((0, _INNER_BACK + _WALL / 2, high), (x, _WALL / 2, high), 0),
    ]


def _panel() -> list[Block]:
    """Return the front of a drawer."""
    return [Block((0, _FACE + _PANEL / 2, _DRAWER_HIGH / 2), (_HALF_DRAWER_X, _PANEL / 2, _DRAWER_HIGH / 2), 0)]


def _handle() -> list[Block]:
    """Return a bar along x on two posts; the gripper can also grasp it by its two ends."""
    z, post = _DRAWER_HIGH / 2, _HANDLE_THICK / 2
    out = _FACE - _HANDLE_OUT
    reach = (_HANDLE_OUT - _HANDLE_THICK) / 2
    return [
        Block((0, out + post, z), (_HANDLE_LENGTH / 2, post, post), 0),
        *(Block((s * (_HANDLE_LENGTH / 2 - 0.004), _FACE - reach, z), (0.004, reach, post), 1) for s in (-1.0, 1.0)),
    ]


def _add(b: Builder, key: str, parts: list[Block], material: str, body: mujoco.MjsBody) -> None:
    """Add the visual mesh of some boards."""
    b.visual_mesh(b.mesh(f"cabinet_{key}", lambda: blocks(parts, tile=0.25)), material, body)


def _cabinet(b: Builder) -> Asset:
    grain = partial(wood, (46, 34, 28), (92, 70, 58), seed=5, waves=7)
    _add(b, "carcass", _carcass(), b.material("cabinet_wood", grain, specular=0.15, shininess=0.2), b.body)
    for part in _carcass():
        b.collision("box", part.half, 0.8, part.centre)
    middle, depth = (_FRONT + _BACK) / 2, (_BACK - _FRONT) / 2
    regions = {"top_side": b.site("top_side", (0, middle, _HIGH - 0.001), (_HALF_X, depth, 0.001), box=True)}
    articulations = {}
    bodies = [b.body]
    for k, level in enumerate(LEVELS):
        drawer = b.child(f"{level}_drawer", (0, 0, _BOARD + k * _PITCH + 0.0015))
        for other in bodies:
            b.spec.add_exclude(bodyname1=other.name, bodyname2=drawer.name)
        bodies.append(drawer)
        joint = b.joint(drawer, f"{level}_level", "slide", (0, 1, 0), DRAWER_RANGE, damping=50, frictionloss=2.0)
        _fill_drawer(b, drawer)
        regions[f"{level}_region"] = _inside(b, drawer, level)
        articulations[f"{level}_region"] = _articulation(b, drawer, level, joint)
    return b.fixture(
        low=(-_HALF_X, _FRONT - _HANDLE_OUT, 0),
        high=(_HALF_X, _BACK, _HIGH),
        regions=regions,
        articulations=articulations,
        clear=depth,
    )


def _fill_drawer(b: Builder, drawer: mujoco.MjsBody) -> None:
    """Add visual and collision geoms of a drawer to its body."""
    dark = partial(wood, (66, 48, 38), (118, 90, 72), seed=6, waves=7)
    light = partial(wood, (150, 118, 84), (196, 164, 124), seed=7, waves=4)
    front = b.material("cabinet_front", dark, specular=0.15, shininess=0.2)
    inside = b.material("cabinet_inside", light, specular=0.1, shininess=0.1)
    metal = b.material("cabinet_metal", rgba=(0.62, 0.62, 0.63, 1), specular=0.8, shininess=0.6)
    _add(b, "drawer", _box(), inside, drawer)
    _add(b, "panel", _panel(), front, drawer)
    _add(b, "handle", _handle(), metal, drawer)
    for part in (*_box(), *_panel()):
        b.collision("box", part.half, 0.12, part.centre, body=drawer)
    for part in _handle():
        b.collision("box", part.half, 0.03, part.centre, body=drawer, friction=GRIP_FRICTION)


def _inside(b: Builder, drawer: mujoco.MjsBody, level: str) -> str:
    """Add the region in a drawer and return its full name."""
    low, high = _FLOOR, _OPENING - 0.0015
    return b.site(
        f"{level}_region",
        (0, (_INNER_FRONT + _INNER_BACK) / 2, (low + high) / 2),
        (_HALF_DRAWER_X - _WALL, (_INNER_BACK - _INNER_FRONT) / 2, (high - low) / 2),
        body=drawer,
        box=True,
    )


def _articulation(b: Builder, drawer: mujoco.MjsBody, level: str, joint: str) -> Articulation:
    handle = (0, _FACE - _HANDLE_OUT + _HANDLE_THICK / 2, _DRAWER_HIGH / 2)
    return Articulation(
        joint=joint,
        kind="drawer",
        closed_q=CLOSED,
        open_q=OPEN,
        handle_site=b.site(f"{level}_handle", handle, body=drawer),
        handle=Handle(_HANDLE_LENGTH, (_HANDLE_THICK, _HANDLE_THICK), _HANDLE_OUT - _HANDLE_THICK),
        open_below=-0.14,
        closed_above=0.0,
    )


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"wooden_cabinet": _cabinet}
