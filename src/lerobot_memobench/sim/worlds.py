"""Select scene builder, placement and predicates by a task's world; evaluate `In` and `On` as LIBERO's code does."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import COLLISION_GROUP
from lerobot_memobench.sim.assets.kitchen import TABLE
from lerobot_memobench.sim.libero.files import check_assets
from lerobot_memobench.sim.libero.placement import LiberoPlacer
from lerobot_memobench.sim.libero.scene import build_scene as build_libero_scene
from lerobot_memobench.sim.placement import Placement, Placer
from lerobot_memobench.sim.scene import Scene, build_scene, scene_key
from lerobot_memobench.sim.world import IN_SLACK, ON_SITE_ABOVE, ON_SITE_BELOW, World
from lerobot_memobench.tasks.task import LIBERO, MEMOBENCH, Task

CACHED_SCENES = 4
"""Compiled scenes cached per process, some MB each; evaluation runs tasks one after another."""


class Places(Protocol):
    """Places fixtures and objects in a simulation."""

    def place(self, seed: int, draw: int = 0) -> Placement:
        """Sample a placement of a seed, write it into model and data, and return it."""


Vector = NDArray[np.float64]


def in_region(place: Vector, position: Vector, rotation: Vector, size: Vector) -> bool:
    """Return whether an origin is in a region.

    LIBERO uses an axis-aligned box with half sides |R·size|, extended downwards by `IN_SLACK`.

    Args:
        place: origin (3,), m.
        position, rotation, size: pose and half sizes of the region's site, (3,), (3, 3) and (3,).
    """
    half = np.abs(rotation @ size)
    low, high = position - half, position + half
    low[2] -= IN_SLACK
    return bool(np.all(place > low) and np.all(place < high))


def over_region(place: Vector, position: Vector, rotation: Vector, size: Vector) -> bool:
    """Return whether an origin is on top of a region, with or without contact; arguments as of `in_region`.

    LIBERO applies the site's rotation where its inverse would be correct.
    """
    offset = rotation @ (place - position)
    above = size[2] - ON_SITE_BELOW < offset[2] < size[2] + ON_SITE_ABOVE
    return bool(above and np.all(np.abs(offset[:2]) < size[:2]))


class LiberoWorld(World):
    """Evaluate predicates as LIBERO's code.

    Differences from `World`, from LIBERO's `site_object.py` and `base_object_states.py`: the formulas of `in_region`
    and `over_region`, and `On` a region of the table needs no contact. Only geoms of robosuite's collision group count
    as contacts.
    """

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        super().__init__(task, model, data, assets)
        self._owner[model.geom_group != COLLISION_GROUP] = -1

    def _in(self, a: str, region: str) -> bool:
        self._index(a)
        return in_region(self._data.body(a).xpos, *self._box_of(region))

    def _on_site(self, a: str, region: str) -> bool:
        self._index(a)
        if not over_region(self._data.body(a).xpos, *self._box_of(region)):
            return False
        declared = self._task.regions.get(region)
        on_table = declared is not None and declared.target == TABLE
        return on_table or self.touching(a, self._owner_of(region))

    def _box_of(self, region: str) -> tuple[Vector, Vector, Vector]:
        """Return position (3,), rotation (3, 3) and half size (3,) of a region's site."""
        site = self._site(region)
        return (
            self._data.site_xpos[site].copy(),
            self._data.site_xmat[site].reshape(3, 3),
            self._model.site_size[site],
        )


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
