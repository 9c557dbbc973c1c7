"""Build the room (table, floor, walls, lights) and the shelf. The table top is at z = 0.90 m with centre x = y = 0."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import mujoco
import numpy as np

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder
from lerobot_memobench.sim.assets.meshes import Block, blocks
from lerobot_memobench.sim.assets.paint import speckle, wood

TABLE = "kitchen_table"
TABLE_SIZE = (1.0, 1.2, 0.05)
TABLE_TOP = 0.90
"""Height of the table's top, m."""
WALL_X = -1.25


def build_kitchen(spec: mujoco.MjSpec) -> Asset:
    """Add table, floor, walls and lights to the world body of ``spec`` and return the table."""
    _light(spec)
    _room(Builder(spec, "room", "room"))
    ground = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name="room_ground", type=ground, size=[3, 3, 0.1], group=0, rgba=[0.5, 0.5, 0.5, 0])
    asset = _table(Builder(spec, TABLE, TABLE))
    spec.body(TABLE).pos = [0, 0, TABLE_TOP]
    return asset


def _light(spec: mujoco.MjSpec) -> None:
    """Add a shadow-casting key light, a fill light and ambient light of the headlight."""
    spec.visual.headlight.ambient = [0.34, 0.34, 0.34]
    spec.visual.headlight.diffuse = [0.16, 0.16, 0.16]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    # Shadow map and clipping planes scale with the extent; a map of the table only has sharp shadows.
    spec.stat.center = [0.0, 0.0, TABLE_TOP]
    spec.stat.extent = 1.0
    spec.visual.map.shadowclip = 1.0
    spec.visual.map.znear = 0.01
    spec.visual.map.zfar = 8.0
    spec.visual.quality.shadowsize = 1024
    direction = np.array([-0.33, 0.24, -0.91])
    spec.worldbody.add_light(
        name="key_light",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=np.array([0.0, 0.0, TABLE_TOP]) - 2.0 * direction,
        dir=direction,
        diffuse=[0.52, 0.51, 0.49],
        specular=[0.25, 0.25, 0.25],
        castshadow=True,
    )
    spec.worldbody.add_light(
        name="fill_light",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[1.5, 1.0, 2.0],
        dir=[-0.8, -0.35, -0.45],
        diffuse=[0.20, 0.20, 0.21],
        specular=[0.0, 0.0, 0.0],
        castshadow=False,
    )


def _room(room: Builder) -> None:
    """Add visual floor and walls."""
    floor = room.material("floor", lambda: speckle((128, 122, 112), 5, seed=11), specular=0.0)
    wall = room.material("wall", lambda: speckle((146, 146, 124), 5, seed=12, along=0.03), specular=0.0)
    room.visual_mesh(room.mesh("room_floor", lambda: blocks([Block((0, 0, -0.05), (2.5, 2.5, 0.05))], 0.8)), floor)
    walls = [
        Block((WALL_X - 0.05, 0, 1.5), (0.05, 2.5, 1.5), 2),
        Block((0, -2.45, 1.5), (2.5, 0.05, 1.5), 2),
        Block((0, 2.45, 1.5), (2.5, 0.05, 1.5), 2),
    ]
    room.visual_mesh(room.mesh("room_walls", lambda: blocks(walls, 0.6)), wall)


def _table(b: Builder) -> Asset:
    """Build the table; its origin is the centre of its top."""
    x, y, thick = TABLE_SIZE[0] / 2, TABLE_SIZE[1] / 2, TABLE_SIZE[2]
    grain = partial(wood, (190, 172, 152), (222, 207, 189), seed=21, size=512, waves=3)
    light = b.material("table", grain, specular=0.05, shininess=0.1)
    leg = b.material("table_leg", rgba=(0.62, 0.52, 0.42, 1), specular=0.05)
    top = Block((0, 0, -thick / 2), (x, y, thick / 2), 0)
    b.visual_mesh(b.mesh("table_top", lambda: blocks([top], tile=1.2)), light)
    high = (TABLE_TOP - thick) / 2
    legs = [
        Block((sx * (x - 0.05), sy * (y - 0.05), -thick - high), (0.03, 0.03, high), 2)
        for sx in (-1.0, 1.0)
        for sy in (-1.0, 1.0)
    ]
    b.visual_mesh(b.mesh("table_legs", lambda: blocks(legs)), leg)
    b.collision("box", top.half, 20.0, top.centre)
    return b.fixture(low=(-x, -y, -TABLE_TOP), high=(x, y, 0.0), regions={}, clear=x)


# Wooden shelf with two layers, open to local -y and to the back ----------------------------------

_SHELF_HALF_X = 0.176
_SHELF_FRONT, _SHELF_BACK = -0.075, 0.116
_SHELF_HIGH = 0.210
_SHELF_BOARD = 0.010
_SHELF_MIDDLE = 0.105  # top of the board between the layers


def _boards() -> list[Block]:
    y, depth = (_SHELF_FRONT + _SHELF_BACK) / 2, (_SHELF_BACK - _SHELF_FRONT) / 2
    inner = _SHELF_HALF_X - _SHELF_BOARD
    high = (_SHELF_HIGH - _SHELF_BOARD) / 2
    side = _SHELF_HALF_X - _SHELF_BOARD / 2
    return [
        *(Block((s * side, y, high), (_SHELF_BOARD / 2, depth, high), 2) for s in (-1.0, 1.0)),
        Block((0, y, _SHELF_HIGH - _SHELF_BOARD / 2), (_SHELF_HALF_X, depth, _SHELF_BOARD / 2), 0),
        Block((0, y, _SHELF_MIDDLE - _SHELF_BOARD / 2), (inner, depth, _SHELF_BOARD / 2), 0),
        Block((0, y, _SHELF_BOARD / 2), (inner, depth, _SHELF_BOARD / 2), 0),
    ]


def _shelf(b: Builder) -> Asset:
    dark = b.material("shelf_wood", lambda: wood((70, 46, 32), (122, 86, 62), seed=9, waves=6), specular=0.15)
    b.visual_mesh(b.mesh("shelf", lambda: blocks(_boards(), tile=0.25)), dark)
    for part in _boards():
        b.collision("box", part.half, 0.5, part.centre)
    y, depth = (_SHELF_FRONT + _SHELF_BACK) / 2, (_SHELF_BACK - _SHELF_FRONT) / 2
    inner = _SHELF_HALF_X - _SHELF_BOARD

    def inside(low: float, high: float, name: str) -> str:
        return b.site(name, (0, y, (low + high) / 2), (inner, depth, (high - low) / 2), box=True)

    regions = {
        "top_side": b.site("top_side", (0, y, _SHELF_HIGH - 0.001), (_SHELF_HALF_X, depth, 0.001), box=True),
        "top_region": inside(_SHELF_MIDDLE, _SHELF_HIGH - _SHELF_BOARD, "top_region"),
        "bottom_region": inside(_SHELF_BOARD, _SHELF_MIDDLE - _SHELF_BOARD, "bottom_region"),
    }
    return b.fixture(
        low=(-_SHELF_HALF_X, _SHELF_FRONT, 0),
        high=(_SHELF_HALF_X, _SHELF_BACK, _SHELF_HIGH),
        regions=regions,
        clear=depth,
    )


BUILDERS: dict[str, Callable[[Builder], Asset]] = {TABLE: _table, "wooden_two_layer_shelf": _shelf}
