"""Answer the atoms of the task language from the simulator's state.

The meaning of each predicate is LIBERO's, so that results compare (paper, section 3.1; `spec/benchmark.md`).
"""

from __future__ import annotations

import mujoco
import numpy as np

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

ON_DISTANCE = 0.03
"""Horizontal distance of origins below which one object counts as on another, m."""
IN_SLACK = 0.01
"""How far under a region's lower bound an origin still counts as in it, m."""
ON_SITE_BELOW, ON_SITE_ABOVE = 0.005, 0.10
"""Heights around a site's top between which an origin counts as on it, m."""


class World:
    """What is true of one simulation, asked atom by atom.

    Positions and contacts must belong to the present state (after `mujoco.mj_step1` or `mujoco.mj_forward`).
    """

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        self._task, self._model, self._data, self._assets = task, model, data, assets
        self._instances = {name: index for index, name in enumerate(assets)}
        self._table = len(self._instances)
        # Which instance each geom belongs to: the root of its body's tree, −1 for robot and room.
        roots = {model.body(name).id: index for name, index in self._instances.items()}
        self._owner = np.full(model.ngeom, -1)
        for geom in range(model.ngeom):
            body = model.geom_bodyid[geom]
            while body > 0 and body not in roots:
                body = model.body_parentid[body]
            self._owner[geom] = roots.get(body, -1)
            if model.geom(geom).name.startswith("kitchen_table"):
                self._owner[geom] = self._table
        self._joints: dict[str, tuple[Articulation, int]] = {}
        for name, asset in assets.items():
            for region, articulation in asset.articulations.items():
                address = int(model.joint(articulation.joint).qposadr[0])
                self._joints[f"{name}_{region}" if region else name] = (articulation, address)

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom is true now.

        Raises:
            MemobenchError: when the atom names something that is not in the scene, or asks a thing that cannot be
                opened or switched.
        """
        match atom.predicate:
            case "in":
                return self._in(*atom.args)
            case "on":
                a, b = atom.args
                return self._on_object(a, b) if b in self._instances else self._on_site(a, b)
            case "open" | "close" | "turnon" | "turnoff":
                return self._articulated(atom.predicate, atom.args[0])
        raise MemobenchError(
            f"the simulator cannot answer {atom.predicate!r}: it knows in, on, open, close, turnon, turnoff"
        )

    def touching(self, a: str, b: str) -> bool:
        """Return whether two instances (or an instance and the table) are in contact."""
        pair = {self._index(a), self._index(b)}
        if self._data.ncon == 0:
            return False
        owners = self._owner[self._data.contact.geom]
        return bool(np.any((owners[:, 0] != owners[:, 1]) & np.isin(owners, list(pair)).all(axis=1)))

    def articulation(self, name: str) -> tuple[Articulation, float]:
        """Return the joint behind a drawer, door or knob, and its position, m or rad."""
        if name not in self._joints:
            raise MemobenchError(
                f"{name!r} of task {self._task.name} cannot be opened or switched; {nearest(name, self._joints)}"
            )
        articulation, address = self._joints[name]
        return articulation, float(self._data.qpos[address])

    def _index(self, name: str) -> int:
        if name == "kitchen_table":
            return self._table
        if name not in self._instances:
            raise MemobenchError(
                f"task {self._task.name} has no object or fixture {name!r}; {nearest(name, self._instances)}"
            )
        return self._instances[name]

    def _articulated(self, predicate: str, name: str) -> bool:
        articulation, q = self.articulation(name)
        limits = {
            "open": (articulation.open_below, lambda bound: q < bound),
            "close": (articulation.closed_above, lambda bound: q > bound),
            "turnon": (articulation.on_at_least, lambda bound: q >= bound),
            "turnoff": (articulation.off_below, lambda bound: q < bound),
        }
        bound, test = limits[predicate]
        if bound is None:
            raise MemobenchError(f"{name!r} is a {articulation.kind}: {predicate!r} has no meaning for it")
        return bool(test(bound))

    def _in(self, a: str, region: str) -> bool:
        self._index(a)
        site = self._site(region)
        local = self._data.site_xmat[site].reshape(3, 3).T @ (self._data.body(a).xpos - self._data.site_xpos[site])
        half = self._model.site_size[site]
        return bool(np.all(np.abs(local[:2]) < half[:2]) and -half[2] - IN_SLACK < local[2] < half[2])

    def _on_object(self, a: str, b: str) -> bool:
        self._index(a)
        above = self._data.body(a).xpos - self._data.body(b).xpos
        if above[2] < 0 or float(np.hypot(above[0], above[1])) >= ON_DISTANCE:
            return False
        return self.touching(a, b)

    def _on_site(self, a: str, region: str) -> bool:
        self._index(a)
        position = self._data.body(a).xpos
        declared = self._task.regions.get(region)
        if declared is not None and declared.target == "kitchen_table":
            inside = any(x1 <= position[0] <= x2 and y1 <= position[1] <= y2 for x1, y1, x2, y2 in declared.ranges)
            height = position[2] - TABLE_TOP
            return inside and -ON_SITE_BELOW < height < ON_SITE_ABOVE and self.touching(a, "kitchen_table")
        site = self._site(region)
        local = self._data.site_xmat[site].reshape(3, 3).T @ (position - self._data.site_xpos[site])
        half = self._model.site_size[site]
        height = local[2] - half[2]
        return bool(np.all(np.abs(local[:2]) < half[:2]) and -ON_SITE_BELOW < height < ON_SITE_ABOVE) and self.touching(
            a, self._parent(region)
        )

    def _site(self, region: str) -> int:
        site = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_SITE, region)
        if site < 0:
            known = [self._model.site(i).name for i in range(self._model.nsite)]
            raise MemobenchError(f"task {self._task.name} has no region {region!r}; {nearest(region, known)}")
        return site

    def _parent(self, region: str) -> str:
        return max((name for name in self._instances if region.startswith(f"{name}_")), key=len)
