"""Compile a task's scene: kitchen, arm, fixtures, objects. Scenes are compiled once; seeds change the state only."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import VISUAL_GROUP
from lerobot_memobench.sim.assets.kitchen import TABLE, build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.detents import add_detents
from lerobot_memobench.sim.libero.files import user_folders
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
    """Published tasks: classes drawn by this package's objects because the paper's scans are not installed."""
    drawing: Callable[[], tuple[mujoco.MjModel, DrawList]] | None = None
    """Returns a visual model with equal bodies and joints, and its draw list; None if ``model`` has visual geoms."""
    opaque_group: int = VISUAL_GROUP
    """Group of the opaque geoms of ``model``."""


def scene_key(task: Task) -> tuple[str, ...]:
    """Return the cache key of a task's scene, which variants of a task share."""
    return task.name, task.suite, task.bddl_text, task.world, *user_folders()


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
    return spec, assets


# --- strict scenes ---

ROLLING_FRICTION = 0.002
"""Rolling friction coefficient, m. In the published scenes an artichoke in a drawer, or a biscuit on its edge, rolls
until it hits something; at the back of a drawer it cannot be grasped from above."""


def stop_rolling(spec: mujoco.MjSpec, names: Iterable[str]) -> None:
    """Add rolling friction to the geoms of objects."""
    for name in names:
        for geom in spec.body(name).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype or geom.conaffinity:
                geom.condim = 6
                geom.friction = [*geom.friction[:2], ROLLING_FRICTION]
