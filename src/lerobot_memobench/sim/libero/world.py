"""Answer `In` and `On` by LIBERO's formulas; drawers, doors and knobs are asked as everywhere."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.builder import COLLISION_GROUP
from lerobot_memobench.sim.assets.kitchen import TABLE
from lerobot_memobench.sim.world import IN_SLACK, ON_SITE_ABOVE, ON_SITE_BELOW, World
from lerobot_memobench.tasks.task import Task


class LiberoWorld(World):
    """What LIBERO's code would answer about one simulation, asked atom by atom.

    Differences from `World`, read in LIBERO's `site_object.py` and `base_object_states.py`:

    - `In` takes the region for a box along the world's axes, whose half sides are \\|R·size\\|, and lets a thing be
      `IN_SLACK` below it along the world's z; R is the rotation of the region's site;
    - `On` a region turns the distance by R, not by its transpose;
    - `On` a region of the table needs no contact.

    Contacts are those of geoms of robosuite's collision group.
    """

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        super().__init__(task, model, data, assets)
        self._owner[model.geom_group != COLLISION_GROUP] = -1

    def _in(self, a: str, region: str) -> bool:
        self._index(a)
        position, rotation, size = self._box_of(region)
        half = np.abs(rotation @ size)
        low, high = position - half, position + half
        low[2] -= IN_SLACK
        place = self._data.body(a).xpos
        return bool(np.all(place > low) and np.all(place < high))

    def _on_site(self, a: str, region: str) -> bool:
        self._index(a)
        position, rotation, size = self._box_of(region)
        offset = rotation @ (self._data.body(a).xpos - position)
        inside = bool(np.all(np.abs(offset[:2]) < size[:2]))
        above = bool(size[2] - ON_SITE_BELOW < offset[2] < size[2] + ON_SITE_ABOVE)
        if not (inside and above):
            return False
        declared = self._task.regions.get(region)
        on_table = declared is not None and declared.target == TABLE
        return on_table or self.touching(a, self._owner_of(region))

    def _box_of(self, region: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return place (3,), rotation (3, 3) and half size (3,) of a region's site."""
        site = self._site(region)
        return (
            self._data.site_xpos[site].copy(),
            self._data.site_xmat[site].reshape(3, 3),
            self._model.site_size[site],
        )
