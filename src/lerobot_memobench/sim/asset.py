"""Metadata of objects and fixtures, used by scenes, predicates and experts; the table, and groups of geoms.

Frames: with yaw 0 an asset's x axis points to the agentview camera; z points up. The origin of an object is its
geometric centre, that of a container (bowl, plate, pan) the centre of its bottom, and that of a fixture is on the
table top. Units are metres, kilograms and radians.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from types import MappingProxyType
from typing import Literal

import numpy as np

TABLE = "kitchen_table"
TABLE_SIZE = (1.0, 1.2, 0.05)
"""Size of the table's board, m."""
TABLE_TOP = 0.90
"""Height of the table's top, m; its centre is at x = y = 0."""
COLLISION_GROUP, VISUAL_GROUP, SITE_GROUP = 0, 1, 4
"""Groups of geoms with contacts, of drawn geoms, and of sites."""

ALONG_X, ALONG_Y = 0.0, float(np.pi / 2)
"""Yaws of a grasp whose fingers close along x or y of the body [rad]."""
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
"""wxyz."""


@dataclass(frozen=True)
class Grasp:
    """A top-down grasp: gripper pointing down, its closing axis level.

    ``position``: centre between the finger tips in the body's frame [m].
    ``yaw``: angle of the closing axis about the body's z [rad]; 0 closes along the body's x.
    ``width``: width of the grasped part [m].
    ``symmetric``: whether position and axis may be rotated together about the body's z axis by any angle.
    """

    position: Triple
    yaw: float
    width: float
    symmetric: bool = False


@dataclass(frozen=True, kw_only=True)
class Articulation:
    """A drawer, door or knob of a fixture, with its handle and the thresholds of its predicates.

    Drawers and doors are open for q < ``open_below`` and closed for q > ``closed_above``; knobs are on for
    q >= ``on_at_least`` and off for q < ``off_below``; inapplicable thresholds are nan.

    ``joint``: its name, for an instance with the instance's name. ``body``: name of the moving body in its class.
    ``handle``: centre of the handle in that body's frame, m. ``handle_quaternion``: rotation from the handle's frame (x
    along it, y into the fixture) to the body's. ``handle_size``: extents along x, y and z, m. ``clearance``: free
    space behind the handle, m. ``closed_q`` and ``open_q``: targets of q (off and on for a knob), m or rad.
    ``ranges``: `init` predicate -> range of initial q. ``shares_origin``: whether the moving body has the fixture's
    origin, so that only the handle distinguishes it from other parts.
    """

    kind: Literal["drawer", "door", "knob"]
    joint: str
    body: str
    handle: Triple
    handle_size: Triple
    clearance: float
    handle_quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    closed_q: float
    open_q: float
    ranges: Mapping[str, tuple[float, float]]
    open_below: float = nan
    closed_above: float = nan
    on_at_least: float = nan
    off_below: float = nan
    shares_origin: bool = False

    @property
    def handle_site(self) -> str:
        """Name of the site at the handle's centre."""
        return f"{self.joint}_handle"


@dataclass(frozen=True)
class Asset:
    """Metadata of one instance.

    ``low`` and ``high``: corners of the bounding box in the body's frame [m], joints at their closed pose.
    ``regions``: region name (``top_region``, ``cook_region``, ...) -> full name of its box site.
    ``articulations``: region name, or ``""`` for the whole fixture -> joint.
    ``supports``: height of the supporting surface in the body's frame: a bowl's floor, else the top [m];
    ``clear_radius``: radius of that surface [m].
    ``glow``: full names of visual geoms that glow while the fixture is on.
    ``round``: whether the outline from above is a circle about the origin.
    ``upright``: rotation from the asset's frame to the body's if another body axis than z points up; all values are in
    the asset's frame.
    """

    name: str
    class_name: str
    kind: Literal["object", "fixture"]
    low: Triple
    high: Triple
    grasps: tuple[Grasp, ...] = ()
    articulations: Mapping[str, Articulation] = field(default_factory=lambda: MappingProxyType({}))
    regions: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    supports: float = 0.0
    clear_radius: float = 0.0
    glow: tuple[str, ...] = ()
    round: bool = False
    upright: Quaternion | None = None

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
