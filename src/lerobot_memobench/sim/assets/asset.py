"""What is known of a built object or fixture: the numbers that a scene, a predicate or an expert asks for.

Frames: x of an asset points to the agentview camera when it is placed with yaw 0, z points up. The origin of
an object is its geometric centre; that of a container (bowl, plate, pan) is the centre of its bottom, and
that of a fixture is on the table top. Units are metres, kilograms and radians.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from types import MappingProxyType
from typing import Literal

import numpy as np

ALONG_X, ALONG_Y = 0.0, float(np.pi / 2)
"""Yaws of a grasp whose fingers close along x or y of the body [rad]."""
Quaternion = tuple[float, float, float, float]
"""wxyz."""


@dataclass(frozen=True)
class Grasp:
    """A top-down grasp: gripper pointing down, its closing axis level.

    ``position``: where the middle between the finger tips goes, in the body's frame [m].
    ``yaw``: angle of the closing axis about the body's z [rad]; 0 closes along the body's x.
    ``width``: what is between the fingers [m].
    ``symmetric``: the grasp may be turned about the body's z axis by any angle, position and axis together.
    """

    position: tuple[float, float, float]
    yaw: float
    width: float
    symmetric: bool = False


@dataclass(frozen=True)
class Handle:
    """A bar to pull or a ridge to turn, in the frame of its site: x along it, y into the fixture.

    ``length``: along x [m]. ``thickness``: the bar's cross-section, y and z [m]. ``clearance``: free space
    behind the bar [m].
    """

    length: float
    thickness: tuple[float, float]
    clearance: float


@dataclass(frozen=True, kw_only=True)
class JointRule:
    """Where a joint counts as open or closed, on or off, and how a moving part is found.

    Drawers and doors are open when q < ``open_below`` and closed when q > ``closed_above``; knobs are on when
    q >= ``on_at_least`` and off when q < ``off_below``; the others' limits are nan. ``closed_q`` and ``open_q`` are
    good targets for q (off and on for a knob), m or rad. ``shares_origin``: the moving body has the fixture's origin,
    so only the handle shows which part it is.
    """

    kind: Literal["drawer", "door", "knob"]
    closed_q: float
    open_q: float
    open_below: float = nan
    closed_above: float = nan
    on_at_least: float = nan
    off_below: float = nan
    shares_origin: bool = False


@dataclass(frozen=True, kw_only=True)
class Articulation(JointRule):
    """A joint that predicates read and experts move.

    ``handle_site``: full name of the site at the handle's middle, which moves along.
    """

    joint: str
    handle_site: str
    handle: Handle


@dataclass(frozen=True)
class Asset:
    """What is known of one built instance.

    ``low`` and ``high``: corners of the bounding box in the body's frame [m], joints at their closed pose.
    ``regions``: region name (``top_region``, ``cook_region``, ...) -> full name of its box site.
    ``articulations``: region name, or ``""`` for the fixture as a whole -> its joint.
    ``supports``: height in the body's frame of the surface on which things are put: a bowl's floor, the top
    of anything else [m]; ``clear_radius``: radius of that surface [m].
    ``glow``: full names of visual geoms whose rgba is ``glow_on`` while the fixture is on, else ``glow_off``.
    ``round``: the outline from above is a circle about the origin.
    ``upright``: from this asset's frame to its body's, where a body stands with another axis than z up; all numbers
    here are of the asset's frame.
    ``seals``: body -> centre and half size in its frame of the board behind a drawer's front that closes its play [m].
    """

    name: str
    class_name: str
    kind: Literal["object", "fixture"]
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    grasps: tuple[Grasp, ...] = ()
    articulations: Mapping[str, Articulation] = field(default_factory=lambda: MappingProxyType({}))
    regions: Mapping[str, str] = field(default_factory=lambda: MappingProxyType({}))
    supports: float = 0.0
    clear_radius: float = 0.0
    glow: tuple[str, ...] = ()
    glow_on: tuple[float, float, float, float] = (1.0, 0.12, 0.04, 1.0)
    glow_off: tuple[float, float, float, float] = (0.34, 0.34, 0.35, 1.0)
    round: bool = False
    upright: Quaternion | None = None
    seals: Mapping[str, tuple[tuple[float, float, float], tuple[float, float, float]]] = field(
        default_factory=lambda: MappingProxyType({})
    )

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
        """Half the size of the smallest origin-centred rectangle around the asset, x and y [m]."""
        return (max(-self.low[0], self.high[0]), max(-self.low[1], self.high[1]))

    @property
    def radius(self) -> float:
        """Radius about the origin, seen from above, that holds everything [m]."""
        if self.round:
            return max(self.half_extents)
        return float(np.hypot(*self.half_extents))
