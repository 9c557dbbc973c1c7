"""Detents of strict scenes: a spring and a stop for each drawer, door and knob.

In the published scenes a drawer that was pushed closed is up to 5 mm deeper than an untouched one, and doors and knobs
rest where they are released, so images reveal past events. In the strict suite each joint has a detent like furniture:
an over-centre spring near the closed end presses the joint against its stop, where it starts. Away from the closed end
the spring is slack and motion is as published.
"""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.sim.asset import SITE_GROUP, Articulation, Asset

Array = NDArray[np.float64]

DETENT_LEVER = 0.05
"""Distance from a hinge to the spring's moving end, m."""
DETENT_OFFSET, DETENT_SLACK = 0.5, 2.5
"""Distance from the spring's fixed end to the path of the moving end, and the spring's rest length, in units of the
distance from dead centre to the closed end."""
STIFF_STOP_SOLREF = (0.004, 1.0)
"""`solref` of the stop: twice the physics step, the stiffest stable value; the spring moves the joint by microns."""

DEAD_CENTRE = {"drawer": 0.009, "door": 0.035, "knob": 0.09}
"""Distance of the spring's dead centre from the closed end, m or rad."""
_DETENT_FORCE = {"drawer": 5.0, "door": 0.45, "knob": 0.15}
"""Force of the spring at the closed end, N or Nm; exceeds the joint's friction at every closed position."""


def add_detents(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
    """Add to each drawer, door and knob a stop at its initial position and a spring that holds it there."""
    for asset in assets.values():
        for articulation in asset.articulations.values():
            joint = spec.joint(articulation.joint)
            joint.solref_limit = list(STIFF_STOP_SOLREF)
            if articulation.kind == "drawer":
                joint.range = [joint.range[0], articulation.closed_q]
            _add_spring(spec, spec.body(asset.name), joint, articulation)


def _add_spring(
    spec: mujoco.MjSpec, fixture: mujoco.MjsBody, joint: mujoco.MjsJoint, articulation: Articulation
) -> None:
    """Add the spring from a fixed point near the path of a point of the moving part to that point."""
    travel, press = DEAD_CENTRE[articulation.kind], _DETENT_FORCE[articulation.kind]
    lever = 1.0 if articulation.kind == "drawer" else DETENT_LEVER
    reach = travel * lever
    dead_centre = articulation.closed_q + np.sign(articulation.open_q - articulation.closed_q) * travel
    point, place = _moving_point(joint, lever, dead_centre)
    turn = Rotation.from_quat(joint.parent.quat, scalar_first=True)  # LIBERO's knob is turned by 90°
    fixed = joint.parent.pos + turn.apply(place) + DETENT_OFFSET * reach * np.array([0.0, 0.0, 1.0])
    ends = {"fixed": (fixture, fixed), "moving": (joint.parent, point)}
    tendon = spec.add_tendon(name=f"{joint.name}_detent", group=SITE_GROUP)
    for end, (body, position) in ends.items():
        name = f"{joint.name}_detent_{end}"
        body.add_site(name=name, pos=position.tolist(), size=[0.001] * 3, group=SITE_GROUP)
        tendon.wrap_site(name)
    closed = float(np.hypot(1.0, DETENT_OFFSET))
    pushes = (DETENT_SLACK - closed) / closed * reach * lever
    stiffness = press / pushes
    # Newer MuJoCo versions expect polynomial coefficients.
    tendon.stiffness = stiffness if np.ndim(tendon.stiffness) == 0 else [stiffness, 0.0, 0.0]
    tendon.springlength = [DETENT_SLACK * reach, 1.0]


def _moving_point(joint: mujoco.MjsJoint, lever: float, q: float) -> tuple[Array, Array]:
    """Return the spring's moving end in the moving part's frame, and its position at ``q`` in the parent's, (3,), m."""
    axis = np.asarray(joint.axis)
    if joint.type == mujoco.mjtJoint.mjJNT_SLIDE:
        return np.zeros(3), q * axis
    point = np.array([lever, 0.0, 0.0])
    return point, Rotation.from_rotvec(q * axis).apply(point)
