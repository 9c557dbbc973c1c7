"""Compile a task's scene: kitchen, arm, fixtures, objects. Once per task and process; seeds change only state."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import mujoco

from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.kitchen import build_kitchen
from lerobot_memobench.sim.assets.registry import build_asset
from lerobot_memobench.sim.catches import add_catches
from lerobot_memobench.sim.rolling import stop_rolling
from lerobot_memobench.tasks.task import STRICT, Task

TABLE = "kitchen_table"
TABLE_TOP = 0.90
"""Height of the table's top, m."""
AGENTVIEW = "agentview"

AGENTVIEW_POSITION = (0.6586131746834771, 0.0, 1.6103500240372423)
AGENTVIEW_QUATERNION = (0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349)
AGENTVIEW_ANGLE = 45.0
"""Its field of view, degrees."""

PHYSICS_STEP = 0.002
SUBSTEPS = round(1 / (CONTROL_HZ * PHYSICS_STEP))

ARENA_BYTES = 32 * 2**20
"""Room for contacts and constraints of one simulation."""
CACHED_SCENES = 4
"""Compiled scenes kept per process: evaluation takes one task after the other, each scene has some MB."""


@dataclass(frozen=True)
class Scene:
    """A compiled scene. The model is shared: whoever changes it works on a copy."""

    key: tuple[str, str, str]
    model: mujoco.MjModel
    assets: dict[str, Asset]
    """Every fixture but the table, then every object, by instance name."""


_scenes: OrderedDict[tuple[str, str, str], Scene] = OrderedDict()


def get_scene(task: Task) -> Scene:
    """Return the compiled scene of a task, from this process's cache where it is there.

    Variants of a task (another referent) share the scene: they differ in goal, not in what stands on the table.
    """
    key = (task.name, task.suite, task.bddl_text)
    if key in _scenes:
        _scenes.move_to_end(key)
        return _scenes[key]
    spec, assets = scene_spec(task)
    scene = Scene(key, spec.compile(), assets)
    _scenes[key] = scene
    while len(_scenes) > CACHED_SCENES:
        _scenes.popitem(last=False)
    return scene


def scene_spec(task: Task) -> tuple[mujoco.MjSpec, dict[str, Asset]]:
    """Return a task's scene as a specification that may still be changed or saved, and its assets by instance."""
    spec = robot.robot_spec()
    spec.modelname = "memobench"
    spec.option.timestep = PHYSICS_STEP
    # robosuite's files reserve room for 5,000 contacts, 1.3 GB of addresses per simulation; no scene uses 1 MB.
    spec.nconmax, spec.njmax, spec.memory = -1, -1, ARENA_BYTES
    build_kitchen(spec)
    place, turn = list(AGENTVIEW_POSITION), list(AGENTVIEW_QUATERNION)
    spec.worldbody.add_camera(name=AGENTVIEW, pos=place, quat=turn, fovy=AGENTVIEW_ANGLE)
    assets: dict[str, Asset] = {}
    for name, class_name in task.fixtures.items():
        if name != TABLE:
            assets[name] = build_asset(spec, spec.worldbody, name, class_name)
    for name, class_name in task.objects.items():
        assets[name] = build_asset(spec, spec.worldbody, name, class_name)
        spec.body(name).add_freejoint(name=f"{name}_joint0")
    if task.suite == STRICT:
        add_catches(spec, assets)
        stop_rolling(spec, task.objects)
    return spec, assets


def state_size(model: mujoco.MjModel) -> int:
    """Length of the flattened state: time, positions, velocities."""
    return int(1 + model.nq + model.nv)
