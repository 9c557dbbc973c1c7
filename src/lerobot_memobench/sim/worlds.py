"""Choose by a task's world what makes its scene, places its things and answers its predicates."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.libero.files import check_assets
from lerobot_memobench.sim.libero.placement import LiberoPlacer
from lerobot_memobench.sim.libero.scene import build_scene as build_libero_scene
from lerobot_memobench.sim.libero.world import LiberoWorld
from lerobot_memobench.sim.placement import Placement, Placer
from lerobot_memobench.sim.scene import Scene, build_scene, scene_key
from lerobot_memobench.sim.world import World
from lerobot_memobench.tasks.task import LIBERO, MEMOBENCH, Task

CACHED_SCENES = 4
"""Compiled scenes kept per process: evaluation takes one task after the other, each scene has some MB."""


class Places(Protocol):
    """Write where everything starts into a simulation."""

    def place(self, seed: int) -> Placement:
        """Draw the placement of a seed, leave it written in model and data, and return it."""


@dataclass(frozen=True)
class Kind:
    """What makes a world.

    Attributes:
        build: compiles a task's scene.
        placer: places the things of a simulation: task, model, data, assets -> placer.
        predicates: answers atoms of a simulation: task, model, data, assets -> world.
        check: raises where a file that its scenes are built of is missing or another one.
    """

    build: Callable[[Task], Scene]
    placer: Callable[[Task, mujoco.MjModel, mujoco.MjData, dict[str, Asset]], Places]
    predicates: Callable[[Task, mujoco.MjModel, mujoco.MjData, dict[str, Asset]], World]
    check: Callable[[], object] = lambda: None


KINDS: dict[str, Kind] = {
    MEMOBENCH: Kind(build_scene, Placer, World),
    LIBERO: Kind(build_libero_scene, LiberoPlacer, LiberoWorld, check_assets),
}

_scenes: OrderedDict[tuple[str, ...], Scene] = OrderedDict()


def get_scene(task: Task) -> Scene:
    """Return the compiled scene of a task in its world, from this process's cache where it is there."""
    key = scene_key(task)
    if key in _scenes:
        _scenes.move_to_end(key)
        return _scenes[key]
    found = KINDS[task.world].build(task)
    _scenes[key] = found
    while len(_scenes) > CACHED_SCENES:
        _scenes.popitem(last=False)
    return found
