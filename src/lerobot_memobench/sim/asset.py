"""Metadata of objects and fixtures, used by scenes, predicates and experts; tables of LIBERO's classes and arenas.

Frames: with yaw 0 an asset's x axis points to the agentview camera; z points up. The origin of an object is its
geometric centre, that of a container (bowl, plate, pan) the centre of its bottom, and that of a fixture is on the
table top. Units are metres, kilograms and radians.

The tables are facts of LIBERO's Python code (`envs/objects`, `problems`, `arenas`, `robots`, MIT licence): initial
rotations of its samplers, joint ranges that count as open, closed, on and off, positions of handles, rooms.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, pi
from typing import Literal

import numpy as np

from lerobot_memobench.sim.robot import BASE_POSITION
from lerobot_memobench.tasks.task import Task

TABLE = "kitchen_table"
TABLE_SIZE = (1.0, 1.2, 0.05)  # size of the table's board, m
TABLE_TOP = 0.90  # height of the table's top, m; its centre is at x = y = 0
COLLISION_GROUP, VISUAL_GROUP, SITE_GROUP = 0, 1, 4  # groups of geoms with contacts, of drawn geoms, and of sites

ALONG_X, ALONG_Y = 0.0, float(np.pi / 2)  # yaws of a grasp whose fingers close along x or y of the body [rad]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # wxyz


@dataclass(frozen=True)
class Grasp:
    """A top-down grasp: gripper pointing down, its closing axis level."""

    position: Triple  # centre between the finger tips in the body's frame, m
    yaw: float  # angle of the closing axis about the body's z, rad; 0 closes along the body's x
    width: float  # of the grasped part, m
    symmetric: bool = False  # whether position and axis may be rotated together about the body's z by any angle


@dataclass(frozen=True, kw_only=True)
class Articulation:
    """A drawer, door or knob of a fixture, with its handle and the thresholds of its predicates, m or rad."""

    kind: Literal["drawer", "door", "knob"]
    joint: str  # its name; of an instance, with the instance's name
    body: str  # name of the moving body in its class
    handle: Triple  # centre of the handle in that body's frame
    handle_size: Triple  # extents along x, y and z
    clearance: float  # free space behind the handle
    handle_quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)  # from the handle's frame (x along it, y in) to the body's
    closed_q: float  # target of q, off for a knob
    open_q: float  # target of q, on for a knob
    ranges: Mapping[str, tuple[float, float]]  # `init` predicate -> range of initial q
    open_below: float = nan  # drawers and doors are open for q below, nan for a knob
    closed_above: float = nan  # and closed for q above
    on_at_least: float = nan  # knobs are on for q from here, nan for drawers and doors
    off_below: float = nan  # and off for q below
    shares_origin: bool = False  # whether the moving body has the fixture's origin, and only the handle is distinct

    @property
    def handle_site(self) -> str:
        """Name of the site at the handle's centre."""
        return f"{self.joint}_handle"


@dataclass(frozen=True)
class Asset:
    """Metadata of one instance; all values are in the asset's frame."""

    name: str
    class_name: str
    kind: Literal["object", "fixture"]
    low: Triple  # corner of the bounding box, m, joints at their closed pose
    high: Triple
    grasps: tuple[Grasp, ...]
    articulations: Mapping[str, Articulation]  # region name, or "" for the whole fixture -> joint
    regions: Mapping[str, str]  # region name (``top_region``, ``cook_region``, ...) -> full name of its box site
    supports: float  # height of the supporting surface: a bowl's floor, else the top, m
    clear_radius: float  # radius of that surface, m
    round: bool  # whether the outline from above is a circle about the origin
    upright: Quaternion | None  # rotation to the body's frame, if another body axis than z points up

    @property
    def bottom(self) -> float:
        """z of the lowest point in the body's frame [m], 0 or below."""
        return self.low[2]

    @property
    def top(self) -> float:
        """z of the highest point in the body's frame [m]."""
        return self.high[2]

    @property
    def half_extents(self) -> tuple[float, float]:
        """Half size of the smallest origin-centred rectangle around the asset, x and y [m]."""
        return (max(-self.low[0], self.high[0]), max(-self.low[1], self.high[1]))

    @property
    def radius(self) -> float:
        """Horizontal radius about the origin that encloses the asset [m]."""
        if self.round:
            return max(self.half_extents)
        return float(np.hypot(*self.half_extents))


def split_class(class_name: str) -> tuple[str, int]:
    """Return family and variant: ``cork__3`` is variant 3 of ``cork``, and ``cork`` is variant 0."""
    match = re.fullmatch(r"(.+?)__(\d+)", class_name)
    return (match.group(1), int(match.group(2))) if match else (class_name, 0)


# --- LIBERO's classes ---

Turn = tuple[str, float, float]  # axis (x, y or z), and the range of the angle, rad
UPRIGHT: Turn = ("x", 0.0, 0.0)
QUARTER: Turn = ("x", pi / 2, pi / 2)
BOTTLE: tuple[Turn, ...] = (QUARTER, ("z", pi / 2, pi / 2))
SCANNED, GROCERY, MODELLED = "stable_scanned_objects", "stable_hope_objects", "turbosquid_objects"
FIXTURE = "articulated_objects"  # folders of MJCF files below the assets folder


@dataclass(frozen=True)
class LiberoClass:
    """Class of an object or fixture."""

    folder: str  # of its MJCF file
    turns: tuple[Turn, ...] = (QUARTER,)  # initial rotations, applied in order; a task states those of fixtures
    parts: tuple[tuple[str, Articulation], ...] = ()  # region and part; "" if atoms use the fixture's name
    grasps: tuple[Grasp, ...] = ()  # from the top; by default at the sides of the bounding box
    floor: float = nan  # height of a container's floor, m; nan for objects that support others on their top
    clear: float = nan  # radius of that floor, m
    round: bool = False  # whether the outline from above is a circle about the origin
    y_up: bool = False  # whether the object's y axis points up; grasps are in the frame with z up (`scene.Y_UP`)

    def mjcf(self, class_name: str) -> str:
        """Return the path of the class's file below the assets folder."""
        folder = self.folder if self.folder == FIXTURE else f"{self.folder}/{class_name}"
        return f"{folder}/{class_name}.xml"


def _bowl(radius: float, height: float, width: float, *, floor: float, clear: float) -> LiberoClass:
    rim = Grasp((radius, 0.0, height), ALONG_X, width, symmetric=True)
    return LiberoClass(SCANNED, grasps=(rim,), floor=floor, clear=clear, round=True)


_DRAWERS = {"top": 0.18393, "middle": 0.11041, "bottom": 0.04114}  # drawer -> height of its handle, m


def _drawer(level: str, height: float) -> Articulation:
    return Articulation(
        kind="drawer",
        joint=f"{level}_level",
        body=f"cabinet_{level}",
        handle=(-0.00278, -0.10161, height),
        handle_size=(0.0889, 0.0154, 0.01634),
        clearance=0.015,
        closed_q=0.0012,  # its front meets the cabinet at 0.0017
        open_q=-0.155,
        ranges={"open": (-0.16, -0.14), "close": (0.0, 0.005)},
        open_below=-0.14,
        closed_above=0.0,
        shares_origin=True,
    )


_DRAWER_PARTS = tuple((f"{level}_region", _drawer(level, height)) for level, height in _DRAWERS.items())
"""Drawers of the wooden and of the white cabinet, which differ in colour and in parts of a millimetre."""
_DOOR = Articulation(
    kind="door",
    joint="microjoint",
    body="microdoorroot",
    handle=(0.2375, -0.054, 0.0),
    handle_size=(0.13, 0.02, 0.02),
    clearance=0.019,
    handle_quaternion=(0.5**0.5, 0.0, -(0.5**0.5), 0.0),
    closed_q=0.0,
    open_q=-1.9,
    ranges={"open": (-2.094, -1.3), "close": (-0.005, 0.0)},
    open_below=-1.3,
    closed_above=-0.005,
)
_KNOB = Articulation(
    kind="knob",
    joint="button",
    body="button",
    handle=(0.0, 0.0, 0.029),
    handle_size=(0.069, 0.024, 0.049),
    clearance=0.03,
    handle_quaternion=(0.5**0.5, 0.0, 0.0, 0.5**0.5),
    closed_q=-0.005,
    open_q=1.0,
    ranges={"turnon": (0.5, 2.1), "turnoff": (-0.005, 0.0)},
    on_at_least=0.5,
    off_below=0.0,
    shares_origin=True,
)

CLASSES: dict[str, LiberoClass] = {
    "akita_black_bowl": _bowl(0.0498, 0.044, 0.006, floor=0.0068, clear=0.039),
    "white_bowl": _bowl(0.0372, 0.0275, 0.005, floor=0.0042, clear=0.022),
    "plate": _bowl(0.0625, 0.0125, 0.012, floor=0.0061, clear=0.040),
    "chefmate_8_frypan": LiberoClass(
        SCANNED,
        grasps=tuple(Grasp((x, 0.0, 0.0442 + 0.126 * (x - 0.1926)), ALONG_Y, 0.0254) for x in (0.145, 0.165, 0.195)),
        floor=0.0128,
        clear=0.072,
    ),
    "bbq_sauce": LiberoClass(
        GROCERY, grasps=(Grasp((0.0, 0.0, 0.0195), ALONG_Y, 0.0286), Grasp((0.0, 0.0, 0.0195), ALONG_X, 0.0362))
    ),
    "butter": LiberoClass(
        GROCERY, (UPRIGHT,), grasps=(Grasp((0.0, 0.0, 0.0), ALONG_Y, 0.0396), Grasp((0.0, 0.0, 0.0), ALONG_X, 0.0762))
    ),
    "milk": LiberoClass(
        GROCERY,
        BOTTLE,
        grasps=(Grasp((0.0, 0.0, 0.029), ALONG_X, 0.0526), Grasp((0.0, 0.0, 0.029), ALONG_Y, 0.0526)),
        y_up=True,
    ),
    "ketchup": LiberoClass(
        GROCERY,
        BOTTLE,
        grasps=(Grasp((0.0004, -0.0008, 0.0405), ALONG_Y, 0.0366), Grasp((0.0004, -0.0008, 0.0405), ALONG_X, 0.033)),
        y_up=True,
    ),
    "moka_pot": LiberoClass(MODELLED, (UPRIGHT,), grasps=(Grasp((0.0, 0.0755, 0.045), ALONG_X, 0.0131),)),
    "wooden_two_layer_shelf": LiberoClass(MODELLED, (UPRIGHT,)),
    "wooden_cabinet": LiberoClass(FIXTURE, parts=_DRAWER_PARTS),
    "microwave": LiberoClass(FIXTURE, parts=(("", _DOOR),)),
    "flat_stove": LiberoClass(FIXTURE, parts=(("", _KNOB),)),
}

SUITE_CLASSES: dict[str, LiberoClass] = {
    **dict.fromkeys(("alphabet_soup", "tomato_sauce"), LiberoClass(GROCERY, BOTTLE[1:], y_up=True)),
    **dict.fromkeys(("new_salad_dressing", "orange_juice", "salad_dressing"), LiberoClass(GROCERY, BOTTLE, y_up=True)),
    **dict.fromkeys(("chocolate_pudding", "cream_cheese"), LiberoClass(GROCERY, (UPRIGHT,))),
    "cookies": LiberoClass(GROCERY),
    **dict.fromkeys(("basket", "glazed_rim_porcelain_ramekin"), LiberoClass(SCANNED)),
    **dict.fromkeys(("desk_caddy", "wine_bottle", "wine_rack", "wooden_tray"), LiberoClass(MODELLED, (UPRIGHT,))),
    **dict.fromkeys(("black_book", "yellow_book"), LiberoClass(MODELLED, (("x", -pi / 2, -pi / 4),))),
    **dict.fromkeys(
        ("porcelain_mug", "red_coffee_mug", "white_yellow_mug"), LiberoClass(MODELLED, (("x", -pi / 2, -pi / 2),))
    ),
    "white_cabinet": LiberoClass(FIXTURE, parts=_DRAWER_PARTS),
}
"""Classes of LIBERO's own suites only, which object observations do not contain."""
ALL_CLASSES = CLASSES | SUITE_CLASSES
UNKNOWN_CLASS = LiberoClass("")  # a scan or a user's class; only its bounding box is known


# --- arenas ---

AGENTVIEW_POSITION = (0.6586131746834771, 0.0, 1.6103500240372423)
AGENTVIEW_QUATERNION = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
AGENTVIEW_ANGLE = 45.0  # vertical field of view of the agentview camera, degrees
LOW_VIEW = (0.6182166934013367, 0.3432307541370392, 0.3432314395904541, 0.6182177066802979)
"""Quaternion wxyz of the agentview camera in the arenas without a mount."""


@dataclass(frozen=True, kw_only=True)
class Arena:
    """A room with a table. Positions in m, quaternions wxyz."""

    file: str  # MJCF, below the assets folder
    floor: str = "light-gray-floor-tile.png"  # texture, below the folder ``textures``
    wall: str = "light-gray-plaster.png"
    body: str  # of the table, which carries the sites of its regions
    zones: Triple  # origin of the regions of these sites in that body's frame
    origin: Triple  # origin of the regions from which placements are drawn
    fixture_drop: float = 0.01 - TABLE_SIZE[2]  # height of a placed fixture's origin above ``origin``
    inset: bool = False  # whether an object's whole outline is drawn inside its region
    lays_out: bool = False  # whether LIBERO's code sets the sizes of the table, those of the kitchen
    friction: Triple | None = None  # of that table; by default that of the file
    base: Triple = BASE_POSITION  # of the arm
    mounted: bool = True  # whether the arm stands on its mount
    camera_position: Triple = AGENTVIEW_POSITION
    camera_quaternion: Quaternion = AGENTVIEW_QUATERNION


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
