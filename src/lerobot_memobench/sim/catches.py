"""Catches: drawers, doors and knobs that come to rest where they began.

In the published scenes a drawer that was pushed shut stands up to 5 mm deeper than one that nobody has touched, and a
door or a knob rests wherever it was let go: who looks closely sees what has happened. In the strict suite each of them
has what furniture has, a spring that is over its dead centre near the closed end and presses against the stop, which
is where the joint starts. Away from the closed end it is slack, and everything moves as published.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.sim.assets.builder import SITE_GROUP

Array = NDArray[np.float64]

LEVER = 0.05
"""Distance from a hinge to the spring's moving end, m."""
OFFSET, SLACK = 0.5, 2.5
"""Of the spring, in distances from dead centre to the closed end: from its fixed end to the way of the moving one, and
the length from which on it does not press."""
STIFF_STOP = (0.004, 1.0)
"""`solref` of the stop: twice the physics step, the stiffest that is stable, so that pressing moves it by microns."""


@dataclass(frozen=True)
class _Catch:
    """How far from the closed end the dead centre is, m or rad, and how hard the spring presses there, N or Nm."""

    travel: float
    press: float


_CATCHES: dict[str, _Catch] = {
    "drawer": _Catch(0.009, 5.0),
    "door": _Catch(0.035, 0.45),
    "knob": _Catch(0.09, 0.15),
}
"""Each presses harder than the joint's friction, from wherever the joint counts as closed or off."""


def add_catches(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
    """Give every drawer, door and knob of a scene a stop where it starts, and the spring that keeps it there."""
    for asset in assets.values():
        for articulation in asset.articulations.values():
            joint = spec.joint(articulation.joint)
            joint.solref_limit = list(STIFF_STOP)
            if articulation.kind == "drawer":
                joint.range = [joint.range[0], articulation.closed_q]
            _add_spring(spec, spec.body(asset.name), joint, articulation)


def _add_spring(
    spec: mujoco.MjSpec, fixture: mujoco.MjsBody, joint: mujoco.MjsJoint, articulation: Articulation
) -> None:
    """Add the spring: it runs from beside the way of a point of the moving part to that point."""
    catch = _CATCHES[articulation.kind]
    lever = 1.0 if articulation.kind == "drawer" else LEVER
    reach = catch.travel * lever
    dead_centre = articulation.closed_q + np.sign(articulation.open_q - articulation.closed_q) * catch.travel
    point, place = _way(joint, lever, dead_centre)
    fixed = joint.parent.pos + place + OFFSET * reach * np.array([0.0, 0.0, 1.0])
    ends = {"fixed": (fixture, fixed), "moving": (joint.parent, point)}
    tendon = spec.add_tendon(name=f"{joint.name}_catch", group=SITE_GROUP)
    for end, (body, position) in ends.items():
        name = f"{joint.name}_catch_{end}"
        body.add_site(name=name, pos=position.tolist(), size=[0.001] * 3, group=SITE_GROUP)
        tendon.wrap_site(name)
    closed = float(np.hypot(1.0, OFFSET))
    pushes = (SLACK - closed) / closed * reach * lever
    stiffness = catch.press / pushes
    # Newer MuJoCo takes the coefficients of a polynomial.
    tendon.stiffness = stiffness if np.ndim(tendon.stiffness) == 0 else [stiffness, 0.0, 0.0]
    tendon.springlength = [SLACK * reach, 1.0]


def _way(joint: mujoco.MjsJoint, lever: float, q: float) -> tuple[Array, Array]:
    """Return the point that moves, in the moving part's frame, and where it is at ``q`` in its parent's, (3,), m."""
    axis = np.asarray(joint.axis)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        return np.zeros(3), q * axis
    point = np.array([lever, 0.0, 0.0])
    return point, Rotation.from_rotvec(q * axis).apply(point)
