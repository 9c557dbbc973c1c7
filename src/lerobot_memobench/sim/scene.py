"""Compile a task's scene: kitchen, arm, fixtures, objects. Scenes are compiled once; seeds change the state only."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.sim.assets.builder import SITE_GROUP, VISUAL_GROUP
from lerobot_memobench.sim.assets.kitchen import TABLE, build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.raster.drawlist import DrawList
from lerobot_memobench.tasks.task import MEMOBENCH, STRICT, Task

Array = NDArray[np.float64]

AGENTVIEW = "agentview"

AGENTVIEW_POSITION = (0.6586131746834771, 0.0, 1.6103500240372423)
AGENTVIEW_QUATERNION = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
AGENTVIEW_ANGLE = 45.0
"""Vertical field of view of the agentview camera, degrees."""

PHYSICS_STEP = 0.002
SUBSTEPS = round(1 / (CONTROL_HZ * PHYSICS_STEP))

ARENA_BYTES = 32 * 2**20
"""Memory for contacts and constraints of one simulation."""


@dataclass(frozen=True)
class Scene:
    """A compiled scene. The model is shared; modify copies only."""

    key: tuple[str, ...]
    model: mujoco.MjModel
    assets: dict[str, Asset]
    """Instance name -> asset: fixtures without the table, then objects; in LIBERO's world objects come first."""
    stand_ins: tuple[str, ...] = ()
    """Classes replaced by boxes because the paper's scans are not installed."""
    drawing: Callable[[], tuple[mujoco.MjModel, DrawList]] | None = None
    """Returns a visual model with equal bodies and joints, and its draw list; None if ``model`` has visual geoms."""
    opaque_group: int = VISUAL_GROUP
    """Group of the opaque geoms of ``model``."""


def scene_key(task: Task) -> tuple[str, ...]:
    """Return the cache key of a task's scene, which variants of a task share."""
    return task.name, task.suite, task.bddl_text, task.world


def build_scene(task: Task) -> Scene:
    """Return the compiled scene of a task in the world `memobench`."""
    spec, assets = scene_spec(task)
    return Scene(scene_key(task), spec.compile(), assets)


def scene_spec(task: Task) -> tuple[mujoco.MjSpec, dict[str, Asset]]:
    """Return a task's scene as an editable specification, and its assets by instance.

    Raises:
        MemobenchError: the task is not in the world `memobench`.
    """
    if task.world != MEMOBENCH:
        raise MemobenchError(
            f"the scene of task {task.name} cannot be written as MJCF in the world {task.world!r}; use world=memobench"
        )
    spec = robot.robot_spec()
    spec.modelname = "memobench"
    spec.option.timestep = PHYSICS_STEP
    # robosuite's files reserve memory for 5,000 contacts, 1.3 GB per simulation; no scene uses 1 MB.
    spec.nconmax, spec.njmax, spec.memory = -1, -1, ARENA_BYTES
    build_kitchen(spec)
    place, turn = list(AGENTVIEW_POSITION), list(AGENTVIEW_QUATERNION)
    spec.worldbody.add_camera(name=AGENTVIEW, pos=place, quat=turn, fovy=AGENTVIEW_ANGLE)
    classes = {**task.fixtures, **task.objects}
    assets = {name: build_asset(spec, name, classes[name]) for name in classes if name != TABLE}
    for name in task.objects:
        spec.body(name).add_freejoint(name=f"{name}_joint0")
    if task.suite == STRICT:
        add_detents(spec, assets)
        stop_rolling(spec, task.objects)
        seal_drawers(spec, assets)
    return spec, assets


# --- strict scenes: detents, rolling friction and sealed drawers ---
#
# Detents: in the published scenes a drawer that was pushed closed is up to 5 mm deeper than an untouched one, and doors
# and knobs rest where they are released, so images reveal past events. In the strict suite each joint has a detent like
# furniture: an over-centre spring near the closed end presses the joint against its stop, where it starts. Away from
# the closed end the spring is slack and motion is as published.
#
# Rolling friction: in the published scenes an artichoke in a drawer, or a biscuit on its edge, rolls until it hits
# something; at the back of a drawer it cannot be grasped from above. In the strict suite, which hides objects, rolling
# friction stops them within a second.
#
# Seals: in the published scenes the wrist camera sees the content of a drawer through gaps of 1.5 mm. In the strict
# suite a board behind the front closes the opening.

DETENT_LEVER = 0.05
"""Distance from a hinge to the spring's moving end, m."""
DETENT_OFFSET, DETENT_SLACK = 0.5, 2.5
"""Distance from the spring's fixed end to the path of the moving end, and the spring's rest length, in units of the
distance from dead centre to the closed end."""
STIFF_STOP_SOLREF = (0.004, 1.0)
"""`solref` of the stop: twice the physics step, the stiffest stable value; the spring moves the joint by microns."""
ROLLING_FRICTION = 0.002
"""Rolling friction coefficient, m."""

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
    fixed = joint.parent.pos + place + DETENT_OFFSET * reach * np.array([0.0, 0.0, 1.0])
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


def stop_rolling(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    """Add rolling friction to the geoms of objects."""
    for name in names:
        for geom in spec.body(name).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype or geom.conaffinity:
                geom.condim = 6
                geom.friction = [*geom.friction[:2], ROLLING_FRICTION]


def seal_drawers(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
    """Add visual boards that close the gaps of drawers."""
    for asset in assets.values():
        for body, (centre, half) in asset.seals.items():
            spec.body(body).add_geom(
                name=f"{body}_seal",
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=list(centre),
                size=list(half),
                group=VISUAL_GROUP,
                contype=0,
                conaffinity=0,
                mass=0.0,
                rgba=[0.28, 0.21, 0.17, 1.0],
            )
