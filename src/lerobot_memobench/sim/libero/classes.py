"""Table of LIBERO's classes: MJCF file, and data from LIBERO's Python code.

Numbers are facts of LIBERO's code (`envs/objects`, MIT licence): initial rotations of its samplers, joint ranges that
count as open, closed, on and off, and positions of handles.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import nan, pi

from lerobot_memobench.sim.asset import ALONG_X, ALONG_Y, Grasp, JointRule

Turn = tuple[str, float, float]
"""Axis (x, y or z), and the range of the angle, rad."""
UPRIGHT: Turn = ("x", 0.0, 0.0)
QUARTER: Turn = ("x", pi / 2, pi / 2)


@dataclass(frozen=True, kw_only=True)
class Part(JointRule):
    """A drawer, door or knob of a fixture.

    Attributes:
        joint: name of the joint.
        body: name of the moving body.
        handle: centre of the handle in that body's frame, m.
        handle_quaternion: rotation from the handle's frame (x along it, y into the fixture) to the body's, wxyz.
        handle_size: length of the handle, and its thickness along y and z, m.
        clearance: free space behind the handle, m.
        ranges: `init` predicate -> range of initial joint positions, m or rad.
    """

    joint: str
    body: str
    handle: tuple[float, float, float]
    handle_size: tuple[float, float, float]
    clearance: float
    ranges: dict[str, tuple[float, float]]
    handle_quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class LiberoClass:
    """Class of an object or fixture.

    Attributes:
        mjcf: path of its file below the assets folder.
        turns: initial rotations, applied in order; fixtures are rotated as stated by the task.
        parts: pairs of region and part; the region is "" if atoms use the fixture's name.
        grasps: top-down grasps; by default at the sides of the bounding box.
        floor, clear: height and radius of a container's floor, m; nan for objects that support others on their top.
        round: whether the outline from above is a circle about the origin.
        y_up: whether the object's y axis points up; grasps are in the frame with z up (`scene.Y_UP`).
    """

    mjcf: str
    turns: tuple[Turn, ...] = (QUARTER,)
    parts: tuple[tuple[str, Part], ...] = ()
    grasps: tuple[Grasp, ...] = ()
    floor: float = nan
    clear: float = nan
    round: bool = False
    y_up: bool = False


def _vessel(name: str, rim: Grasp, floor: float, clear: float) -> LiberoClass:
    file = f"stable_scanned_objects/{name}/{name}.xml"
    return LiberoClass(file, grasps=(rim,), floor=floor, clear=clear, round=True)


def _grocery(name: str, *turns: Turn, grasps: tuple[Grasp, ...], y_up: bool = False) -> LiberoClass:
    return LiberoClass(f"stable_hope_objects/{name}/{name}.xml", turns, grasps=grasps, y_up=y_up)


def _modelled(name: str, grasps: tuple[Grasp, ...] = ()) -> LiberoClass:
    return LiberoClass(f"turbosquid_objects/{name}/{name}.xml", (UPRIGHT,), grasps=grasps)


def _rim(radius: float, height: float, width: float) -> Grasp:
    return Grasp((radius, 0.0, height), ALONG_X, width, symmetric=True)


_DRAWERS = {"top": 0.18393, "middle": 0.11041, "bottom": 0.04114}
"""Drawer -> height of its handle, m."""


def _drawer(level: str, height: float) -> Part:
    return Part(
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
_DOOR = Part(
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
_KNOB = Part(
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
    "akita_black_bowl": _vessel("akita_black_bowl", _rim(0.0498, 0.044, 0.006), floor=0.0068, clear=0.039),
    "white_bowl": _vessel("white_bowl", _rim(0.0372, 0.0275, 0.005), floor=0.0042, clear=0.022),
    "plate": _vessel("plate", _rim(0.0625, 0.0125, 0.012), floor=0.0061, clear=0.040),
    "chefmate_8_frypan": LiberoClass(
        "stable_scanned_objects/chefmate_8_frypan/chefmate_8_frypan.xml",
        grasps=tuple(Grasp((x, 0.0, 0.0442 + 0.126 * (x - 0.1926)), ALONG_Y, 0.0254) for x in (0.145, 0.165, 0.195)),
        floor=0.0128,
        clear=0.072,
    ),
    "bbq_sauce": _grocery(
        "bbq_sauce",
        QUARTER,
        grasps=(Grasp((0.0, 0.0, 0.0195), ALONG_Y, 0.0286), Grasp((0.0, 0.0, 0.0195), ALONG_X, 0.0362)),
    ),
    "butter": _grocery(
        "butter", UPRIGHT, grasps=(Grasp((0.0, 0.0, 0.0), ALONG_Y, 0.0396), Grasp((0.0, 0.0, 0.0), ALONG_X, 0.0762))
    ),
    "milk": _grocery(
        "milk",
        QUARTER,
        ("z", pi / 2, pi / 2),
        grasps=(Grasp((0.0, 0.0, 0.029), ALONG_X, 0.0526), Grasp((0.0, 0.0, 0.029), ALONG_Y, 0.0526)),
        y_up=True,
    ),
    "ketchup": _grocery(
        "ketchup",
        QUARTER,
        ("z", pi / 2, pi / 2),
        grasps=(Grasp((0.0004, -0.0008, 0.0405), ALONG_Y, 0.0366), Grasp((0.0004, -0.0008, 0.0405), ALONG_X, 0.033)),
        y_up=True,
    ),
    "moka_pot": _modelled("moka_pot", (Grasp((0.0, 0.0755, 0.045), ALONG_X, 0.0131),)),
    "wooden_two_layer_shelf": _modelled("wooden_two_layer_shelf"),
    "wooden_cabinet": LiberoClass("articulated_objects/wooden_cabinet.xml", parts=_DRAWER_PARTS),
    "microwave": LiberoClass("articulated_objects/microwave.xml", parts=(("", _DOOR),)),
    "flat_stove": LiberoClass("articulated_objects/flat_stove.xml", parts=(("", _KNOB),)),
}


def _upright_grocery(name: str, *turns: Turn) -> LiberoClass:
    return _grocery(name, *turns, grasps=(), y_up=True)


def _turned(name: str, low: float, high: float) -> LiberoClass:
    return LiberoClass(f"turbosquid_objects/{name}/{name}.xml", (("x", low, high),))


_TURNED_CAN: Turn = ("z", pi / 2, pi / 2)
_BOTTLE = QUARTER, ("z", pi / 2, pi / 2)

SUITE_CLASSES: dict[str, LiberoClass] = {
    **{name: _upright_grocery(name, _TURNED_CAN) for name in ("alphabet_soup", "tomato_sauce")},
    **{name: _upright_grocery(name, *_BOTTLE) for name in ("new_salad_dressing", "orange_juice", "salad_dressing")},
    **{name: _grocery(name, UPRIGHT, grasps=()) for name in ("chocolate_pudding", "cream_cheese")},
    "cookies": _grocery("cookies", QUARTER, grasps=()),
    **{
        name: LiberoClass(f"stable_scanned_objects/{name}/{name}.xml")
        for name in ("basket", "glazed_rim_porcelain_ramekin")
    },
    **{name: _modelled(name) for name in ("desk_caddy", "wine_bottle", "wine_rack", "wooden_tray")},
    **{name: _turned(name, -pi / 2, -pi / 4) for name in ("black_book", "yellow_book")},
    **{name: _turned(name, -pi / 2, -pi / 2) for name in ("porcelain_mug", "red_coffee_mug", "white_yellow_mug")},
    "white_cabinet": LiberoClass("articulated_objects/white_cabinet.xml", parts=_DRAWER_PARTS),
}
"""Classes of LIBERO's own suites only, which object observations do not contain."""
ALL_CLASSES = CLASSES | SUITE_CLASSES


def parts_of(class_name: str) -> tuple[tuple[str, Part], ...]:
    """Return the parts of a class; objects and scans have none."""
    return ALL_CLASSES[class_name].parts if class_name in ALL_CLASSES else ()
