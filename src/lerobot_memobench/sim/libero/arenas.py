"""Table of LIBERO's arenas: files, and data from LIBERO's Python code.

Numbers are facts of LIBERO's code (`envs/problems`, `envs/arenas`, `envs/robots`, MIT licence).
"""

from __future__ import annotations

from dataclasses import dataclass

from lerobot_memobench.sim.asset import TABLE, TABLE_SIZE, TABLE_TOP
from lerobot_memobench.sim.robot import BASE_POSITION
from lerobot_memobench.sim.scene import AGENTVIEW_POSITION, AGENTVIEW_QUATERNION
from lerobot_memobench.tasks.task import Task

Triple = tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class Arena:
    """A room with a table.

    Attributes:
        file: path of its MJCF file below the assets folder.
        floor, wall: textures, below the folder ``textures``.
        body: body of the table, which carries the sites of its regions.
        zones: origin of the regions of these sites in that body's frame, m.
        origin: origin of the regions from which placements are drawn, m.
        fixture_drop: height of a placed fixture's origin above ``origin``, m.
        inset: whether an object's whole outline is drawn inside its region.
        lays_out: whether LIBERO's code sets the sizes of the table, those of the kitchen.
        friction: friction of that table; by default that of the file.
        base: position of the arm's base, m.
        mounted: whether the arm stands on its mount.
        camera_position, camera_quaternion: pose of the agentview camera, m and wxyz.
    """

    file: str
    floor: str = "light-gray-floor-tile.png"
    wall: str = "light-gray-plaster.png"
    body: str
    zones: Triple
    origin: Triple
    fixture_drop: float = 0.01 - TABLE_SIZE[2]
    inset: bool = False
    lays_out: bool = False
    friction: Triple | None = None
    base: Triple = BASE_POSITION
    mounted: bool = True
    camera_position: Triple = AGENTVIEW_POSITION
    camera_quaternion: tuple[float, float, float, float] = AGENTVIEW_QUATERNION


LOW_VIEW = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
"""Quaternion wxyz of the agentview camera in the arenas without a mount."""

ARENAS: dict[str, Arena] = {
    TABLE: Arena(
        file="scenes/libero_kitchen_tabletop_base_style.xml",
        floor="gray_ceramic_tile.png",
        wall="yellow_linen_wall_texture.png",
        body="table",
        zones=(0.0, 0.0, 0.0),
        origin=(0.0, 0.0, TABLE_TOP),
        lays_out=True,
    ),
    "table": Arena(
        file="scenes/libero_tabletop_base_style.xml",
        body="table",
        zones=(0.0, 0.0, 0.02),
        origin=(0.0, 0.0, TABLE_TOP),
        inset=True,
        lays_out=True,
        friction=(0.6, 0.005, 0.0001),
    ),
    "living_room_table": Arena(
        file="scenes/libero_living_room_tabletop_base_style.xml",
        floor="seamless_wood_planks_floor.png",
        body="living_room_table",
        zones=(0.0, 0.0, 0.41),
        origin=(0.0, 0.0, 0.41),
        fixture_drop=0.01 - 0.024,
        base=(-0.51, 0.0, 0.42),
        mounted=False,
        camera_position=(0.6065773716836134, 0.0, 0.96),
        camera_quaternion=LOW_VIEW,
    ),
    "study_table": Arena(
        file="scenes/libero_study_base_style.xml",
        body="study_table",
        zones=(-0.2, 0.0, 0.867),
        origin=(-0.2, 0.0, 0.867),
        base=(-0.75, 0.0, 0.0),
        camera_position=(0.4586131746834771, 0.0, 1.6103500240372423),
    ),
    "floor": Arena(
        file="scenes/libero_floor_base_style.xml",
        body="floor",
        zones=(0.0, 0.0, 0.02),
        origin=(0.0, 0.0, -0.035),
        fixture_drop=-0.025,
        inset=True,
        base=(-0.6, 0.0, 0.0),
        mounted=False,
        camera_position=(0.8965773716836134, 5.216182733499864e-07, 0.65),
        camera_quaternion=LOW_VIEW,
    ),
}
"""Class of the table or floor in a task's file -> arena."""


def arena_of(task: Task) -> Arena:
    """Return the arena of a task, the kitchen for a task without a table."""
    return next((ARENAS[name] for name in task.fixtures.values() if name in ARENAS), ARENAS[TABLE])
