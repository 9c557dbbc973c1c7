"""Compile a task's scene: kitchen, arm, fixtures, objects; once per task and process, seeds change only state."""

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
"""Its field of view, degrees."""

PHYSICS_STEP = 0.002
SUBSTEPS = round(1 / (CONTROL_HZ * PHYSICS_STEP))

ARENA_BYTES = 32 * 2**20
"""Room for contacts and constraints of one simulation."""


@dataclass(frozen=True)
class Scene:
    """A compiled scene. The model is shared: change a copy only."""

    key: tuple[str, ...]
    model: mujoco.MjModel
    assets: dict[str, Asset]
    """Every fixture but the table, then every object, by instance name; in LIBERO's world objects go first."""
    stand_ins: tuple[str, ...] = ()
    """Classes that are boxes, because the user does not have the paper's scans of them."""
    drawing: Callable[[], tuple[mujoco.MjModel, DrawList]] | None = None
    """Returns a model with lights, of the same bodies and joints, and what to draw of it, where ``model`` has no
    visual geoms."""
    opaque_group: int = VISUAL_GROUP
    """Group of the geoms of ``model`` that hide things behind them."""


def scene_key(task: Task) -> tuple[str, ...]:
    """Return the name of a task's scene. Variants of a task (another referent) share it: they differ in goal."""
    return task.name, task.suite, task.bddl_text, task.world


def build_scene(task: Task) -> Scene:
    """Return the compiled scene of a task in this package's own world."""
    spec, assets = scene_spec(task)
    return Scene(scene_key(task), spec.compile(), assets)


def scene_spec(task: Task) -> tuple[mujoco.MjSpec, dict[str, Asset]]:
    """Return a task's scene as a specification that may still be changed or saved, and its assets by instance.

    Raises:
        MemobenchError: the task is in another world than this package's own.
    """
    if task.world != MEMOBENCH:
        raise MemobenchError(
            f"the scene of task {task.name} is not written as MJCF in the world {task.world!r}; take world=memobench"
        )
    spec = robot.robot_spec()
    spec.modelname = "memobench"
    spec.option.timestep = PHYSICS_STEP
    # robosuite's files reserve room for 5,000 contacts, 1.3 GB of addresses per simulation; no scene uses 1 MB.
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


# --- strict scenes: detents and rolling friction ---
#
# In the published scenes a drawer that was pushed shut stands up to 5 mm deeper than one that nobody has touched, and a
# door or a knob rests wherever it was let go: a close look shows what has happened. In the strict suite each has a
# detent, as furniture does: a spring that is over its dead centre near the closed end and presses against the stop,
# which is where the joint starts. Away from the closed end it is slack, and everything moves as published.
#
# In the published scenes an artichoke in a drawer, or a biscuit on its edge, rolls on until something stops it; at the
# back of a shut drawer no hand from above can take it. In the strict suite, where things are hidden and found, rolling
# friction brings them to rest within a second.
#
# In the published scenes a drawer has a play of 1.5 mm, through which the wrist camera sees its content. In the strict
# suite a board behind the front fills the opening.

LEVER = 0.05
"""Distance from a hinge to the spring's moving end, m."""
OFFSET, SLACK = 0.5, 2.5
"""Of the spring, in distances from dead centre to the closed end: from its fixed end to the way of the moving one, and
the length from which on it does not press."""
STIFF_STOP = (0.004, 1.0)
"""`solref` of the stop: twice the physics step, the stiffest that is stable, so that pressing moves it by microns."""
ROLLING = 0.002
"""Rolling friction, m: how far from under the middle a surface holds a thing that rolls."""


DEAD_CENTRE = {"drawer": 0.009, "door": 0.035, "knob": 0.09}
"""Distance of the spring's dead centre from the closed end, m or rad."""
_PRESS = {"drawer": 5.0, "door": 0.45, "knob": 0.15}
"""Force of the spring at the closed end, N or Nm: more than the joint's friction, from wherever it counts as closed or
off."""


def add_detents(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
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
    travel, press = DEAD_CENTRE[articulation.kind], _PRESS[articulation.kind]
    lever = 1.0 if articulation.kind == "drawer" else LEVER
    reach = travel * lever
    dead_centre = articulation.closed_q + np.sign(articulation.open_q - articulation.closed_q) * travel
    point, place = _way(joint, lever, dead_centre)
    fixed = joint.parent.pos + place + OFFSET * reach * np.array([0.0, 0.0, 1.0])
    ends = {"fixed": (fixture, fixed), "moving": (joint.parent, point)}
    tendon = spec.add_tendon(name=f"{joint.name}_detent", group=SITE_GROUP)
    for end, (body, position) in ends.items():
        name = f"{joint.name}_detent_{end}"
        body.add_site(name=name, pos=position.tolist(), size=[0.001] * 3, group=SITE_GROUP)
        tendon.wrap_site(name)
    closed = float(np.hypot(1.0, OFFSET))
    pushes = (SLACK - closed) / closed * reach * lever
    stiffness = press / pushes
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


def stop_rolling(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    """Give what the bodies of objects touch something to hold them by as they roll."""
    for name in names:
        for geom in spec.body(name).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype or geom.conaffinity:
                geom.condim = 6
                geom.friction = [*geom.friction[:2], ROLLING]


def seal_drawers(spec: mujoco.MjSpec, assets: Mapping[str, Asset]) -> None:
    """Add the boards that close the play of drawers: they are seen, and touched by nothing."""
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
