"""The room: table, floor, walls and light. The table's top is at z = 0.90 m, its middle at x = y = 0."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import Builder
from lerobot_memobench.sim.assets.meshes import Block, blocks
from lerobot_memobench.sim.assets.paint import Pixels, speckle, wood

TABLE_SIZE = (1.0, 1.2, 0.05)
TABLE_TOP = 0.90
WALL_X = -1.25


def build_kitchen(spec: mujoco.MjSpec, table: str = "kitchen_table") -> Asset:
    """Add table, floor, walls and lights to the world body of ``spec`` and return the table."""
    _light(spec)
    _room(Builder(spec, spec.worldbody, "room", "room"))
    spec.worldbody.add_geom(
        name="room_ground",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[3, 3, 0.1],
        group=0,
        rgba=[0.5, 0.5, 0.5, 0],
    )
    asset = _table(Builder(spec, spec.worldbody, table, "kitchen_table"))
    spec.body(table).pos = [0, 0, TABLE_TOP]
    return asset


def _light(spec: mujoco.MjSpec) -> None:
    """Add the lights: one casts shadows; a second one and the headlight's ambience fill in."""
    spec.visual.headlight.ambient = [0.34, 0.34, 0.34]
    spec.visual.headlight.diffuse = [0.16, 0.16, 0.16]
    spec.visual.headlight.specular = [0.0, 0.0, 0.0]
    # Shadow map and clipping planes go by the extent: a map over the table alone has sharp shadows.
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
    """Add floor and walls, which are only seen."""
    floor = room.material("floor", lambda: speckle((128, 122, 112), 5, seed=11), specular=0.0)
    wall = room.material("wall", lambda: speckle((146, 146, 124), 5, seed=12, along=0.03), specular=0.0)
    room.visual_mesh(room.mesh("room_floor", lambda: blocks([Block((0, 0, -0.05), (2.5, 2.5, 0.05))], 0.8)), floor)
    walls = [
        Block((WALL_X - 0.05, 0, 1.5), (0.05, 2.5, 1.5), 2),
        Block((0, -2.45, 1.5), (2.5, 0.05, 1.5), 2),
        Block((0, 2.45, 1.5), (2.5, 0.05, 1.5), 2),
    ]
    room.visual_mesh(room.mesh("room_walls", lambda: blocks(walls, 0.6)), wall)


def _table_texture() -> Pixels:
    return wood((190, 172, 152), (222, 207, 189), seed=21, size=512, waves=3)


def _table(b: Builder) -> Asset:
    """Build the table; its origin is the middle of its top."""
    x, y, thick = TABLE_SIZE[0] / 2, TABLE_SIZE[1] / 2, TABLE_SIZE[2]
    light = b.material("table", _table_texture, specular=0.05, shininess=0.1)
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


BUILDERS: dict[str, Callable[[Builder], Asset]] = {"kitchen_table": _table}
