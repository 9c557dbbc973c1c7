"""Select scene builder, placement and predicates by a task's world."""

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
"""Compiled scenes cached per process, some MB each; evaluation runs tasks one after another."""


class Places(Protocol):
    """Places fixtures and objects in a simulation."""

    def place(self, seed: int) -> Placement:
        """Sample the placement of a seed, write it into model and data, and return it."""


@dataclass(frozen=True)
class Kind:
    """Components of a world.

    Attributes:
        build: compiles a task's scene.
        placer: returns the placer of a simulation from task, model, data, assets.
        predicates: returns the evaluator of atoms of a simulation from task, model, data, assets.
        check: raises `MemobenchError` if an asset file is missing or has unexpected content.
    """

    build: Callable[[Task], Scene]
    placer: Callable[[Task, mujoco.MjModel, mujoco.MjData, dict[str, Asset]], Places]
    predicates: Callable[[Task, mujoco.MjModel, mujoco.MjData, dict[str, Asset]], World]
    check: Callable[[], object] = lambda: None


WORLDS: dict[str, Kind] = {
    MEMOBENCH: Kind(build_scene, Placer, World),
    LIBERO: Kind(build_libero_scene, LiberoPlacer, LiberoWorld, check_assets),
}

_scenes: OrderedDict[tuple[str, ...], Scene] = OrderedDict()


def get_scene(task: Task) -> Scene:
    """Return the compiled scene of a task in its world, cached per process."""
    key = scene_key(task)
    if key in _scenes:
        _scenes.move_to_end(key)
        return _scenes[key]
    scene = _scenes[key] = WORLDS[task.world].build(task)
    while len(_scenes) > CACHED_SCENES:
        _scenes.popitem(last=False)
    return scene
