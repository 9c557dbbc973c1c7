"""Answer the atoms of the task language from the simulator's state.

`World` knows the predicates of the present, whose meaning is LIBERO's, so that results compare (paper, section 3.1).
`Start` knows those that compare the present with how the episode began: is the hand home, is a thing in its place?
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.assets.asset import Articulation, Asset
from lerobot_memobench.sim.assets.kitchen import TABLE, TABLE_TOP
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

ON_DISTANCE = 0.03
"""Horizontal distance of origins below which one object counts as on another, m."""
IN_SLACK = 0.01
"""How far under a region's lower bound an origin still counts as in it, m."""
ON_SITE_BELOW, ON_SITE_ABOVE = 0.005, 0.10
"""Heights around a site's top between which an origin counts as on it, m."""

DETENT_DISTANCE = 0.02
"""How far from where it was the grip site is caught, m: twice what learned policies miss it by."""
DETENT_ANGLE = 0.1
"""How far the hand may be turned from how it was, rad."""
DETENT_OPENING = 0.01
"""How far each finger may be from where it was, m: a hand that holds something is not caught."""
DETENT_SPEED = (0.03, 0.15)
"""How fast the hand may be, m/s and rad/s: learned policies hover at 2 cm/s. An action of 0.2 leaves in a step."""
SAME_ARM = 1e-4
"""Difference of the arm's joints and fingers (rad, m) and their velocities up to which it stands as it did: states that
were read from a file are rounded."""
PLACE_DISTANCE = 0.01
"""How far a thing may be from where it stood, m: two pixels, up to which pictures count as the same."""


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
            if model.geom(geom).name.startswith(TABLE):
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
        if name == TABLE:
            return self._table
        if name not in self._instances:
            raise MemobenchError(
                f"task {self._task.name} has no object or fixture {name!r}; {nearest(name, self._instances)}"
            )
        return self._instances[name]

    def _articulated(self, predicate: str, name: str) -> bool:
        articulation, q = self.articulation(name)
        limit, holds = {
            "open": (articulation.open_below, q < articulation.open_below),
            "close": (articulation.closed_above, q > articulation.closed_above),
            "turnon": (articulation.on_at_least, q >= articulation.on_at_least),
            "turnoff": (articulation.off_below, q < articulation.off_below),
        }[predicate]
        if isnan(limit):
            raise MemobenchError(f"{name!r} is a {articulation.kind}: {predicate!r} has no meaning for it")
        return holds

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
        if declared is not None and declared.target == TABLE:
            inside = any(x1 <= position[0] <= x2 and y1 <= position[1] <= y2 for x1, y1, x2, y2 in declared.ranges)
            height = position[2] - TABLE_TOP
            return inside and -ON_SITE_BELOW < height < ON_SITE_ABOVE and self.touching(a, TABLE)
        site = self._site(region)
        local = self._data.site_xmat[site].reshape(3, 3).T @ (position - self._data.site_xpos[site])
        half = self._model.site_size[site]
        height = local[2] - half[2]
        inside = bool(np.all(np.abs(local[:2]) < half[:2]) and -ON_SITE_BELOW < height < ON_SITE_ABOVE)
        return inside and self.touching(a, self._owner_of(region))

    def _site(self, region: str) -> int:
        site = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_SITE, region)
        if site < 0:
            known = [self._model.site(i).name for i in range(self._model.nsite)]
            raise MemobenchError(f"task {self._task.name} has no region {region!r}; {nearest(region, known)}")
        return site

    def _owner_of(self, region: str) -> str:
        return max((name for name in self._instances if region.startswith(f"{name}_")), key=len)


class Start:
    """What the present is compared with: the hand's pose after the scene settled, things as the execution found them.

    Within any tolerance a pose can carry a number. So nothing is tolerated: in strict scenes home has a detent, and an
    arm counts as home only as the detent makes it stand (`in_detent`).

    Args:
        model, data: a simulation's; poses must belong to the present state.
        things: names of the instances whose places are remembered.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, things: Sequence[str]) -> None:
        self._data = data
        self._grip = model.site(robot.GRIP_SITE).id
        self._model = model
        self._fingers = [int(model.joint(name).qposadr[0]) for name in robot.FINGER_JOINTS]
        self._joints = slice(0, max(self._fingers) + 1)  # the arm comes first in the model, its fingers last of it
        self._bodies = {name: int(model.body(name).id) for name in things}
        self.mark_hand()

    def mark_hand(self) -> None:
        """Take the arm's present state for its home."""
        self._arm, self._stood = self._arm_now(), False
        self._position, self._rotation, self._opening = self._hand()

    @property
    def home(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,) and rotation (3, 3) of the grip site at home."""
        return self._position, self._rotation

    def mark_step(self, goes_on: bool = True) -> None:
        """Note where a step begins: who leaves home in it was there. A state that does not go on was not left."""
        self._stood = goes_on and self._stands()

    def mark_things(self) -> None:
        """Take every thing's present place for its own."""
        self._places = {name: self._data.xpos[body].copy() for name, body in self._bodies.items()}

    def holds(self, atom: Atom) -> bool:
        """Return whether ``handhome`` or ``inplace`` is true now."""
        if atom.predicate == "handhome":
            return self._stood or self._stands()
        (name,) = atom.args
        moved = self._data.xpos[self._bodies[name]] - self._places[name]
        return float(np.linalg.norm(moved)) <= PLACE_DISTANCE

    def _stands(self) -> bool:
        """Whether the arm stands as when the scene had settled, joint for joint."""
        return bool(np.abs(self._arm_now() - self._arm).max() <= SAME_ARM)

    def in_detent(self) -> bool:
        """Return whether the open hand has come to rest near its home, so that the detent catches it."""
        return self.at_detent() and bool(np.all(self._speed() <= DETENT_SPEED))

    def at_detent(self) -> bool:
        """Return whether the open hand is so near its home that the detent would catch it at rest."""
        position, rotation, opening = self._hand()
        cosine = (np.trace(self._rotation.T @ rotation) - 1.0) / 2.0
        return bool(
            np.linalg.norm(position - self._position) <= DETENT_DISTANCE
            and np.arccos(np.clip(cosine, -1.0, 1.0)) <= DETENT_ANGLE
            and np.all(np.abs(opening - self._opening) <= DETENT_OPENING)
        )

    def _speed(self) -> NDArray[np.float64]:
        """Speed of the grip site, m/s and rad/s, (2,)."""
        velocity = np.empty(6)  # the turning first
        site = mujoco.mjtObj.mjOBJ_SITE
        mujoco.mj_objectVelocity(self._model, self._data, site, self._grip, velocity, 0)
        return np.array([np.linalg.norm(velocity[3:]), np.linalg.norm(velocity[:3])])

    def _arm_now(self) -> NDArray[np.float64]:
        """Positions and velocities of arm and fingers."""
        return np.append(self._data.qpos[self._joints], self._data.qvel[self._joints])

    def _hand(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Position (3,), rotation (3, 3) of the grip site and finger positions (2,)."""
        data = self._data
        rotation = data.site_xmat[self._grip].reshape(3, 3).copy()
        return data.site_xpos[self._grip].copy(), rotation, data.qpos[self._fingers].copy()
