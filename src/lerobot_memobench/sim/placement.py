"""Sample a task's initial state from its regions and `init` atoms."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.assets.kitchen import TABLE, TABLE_TOP
from lerobot_memobench.tasks.bddl import Region
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

MAX_DRAWS = 500
"""Maximum number of draws without overlap-free placement."""
MAX_CONTACT_DEPTH = 0.0015
"""Largest contact depth of objects at rest; deeper contacts are overlaps, m."""
DROP_HEIGHT = 0.0005
"""Initial height of an object above its support, m."""

Pose = NDArray[np.float64]
"""Position and quaternion wxyz, (7,)."""


@dataclass(frozen=True)
class Placement:
    """Initial poses and joint positions."""

    poses: dict[str, Pose]
    """World pose of each fixture and object."""
    joints: dict[str, float]
    """Position of each articulated joint, m or rad."""


def placing_atoms(task: Task, assets: Iterable[str]) -> dict[str, Atom]:
    """Return the placing `init` atom of each instance, in the order of `init`.

    Raises:
        MemobenchError: an instance has no placing atom.
    """
    places = {atom.args[0]: atom for atom in task.init if atom.predicate in ("on", "in")}
    missing = [name for name in assets if name not in places]
    if missing:
        raise MemobenchError(
            f"task {task.name} has no start for {missing[0]!r}; add (On {missing[0]} <region>) to its :init"
        )
    return places


class Placer:
    """Sample placements of one task and write them into a simulation.

    Args:
        task: task whose `init` atoms define the placement.
        model: model of the simulation; the poses of fixtures are changed.
        data: state that is written and checked for overlaps.
        assets: sizes and joints by instance.
    """

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        self._task, self._model, self._data, self._assets = task, model, data, assets
        self._places = placing_atoms(task, assets)
        self._order = self._sorted()

    def _sorted(self) -> list[str]:
        """Return the instances, each after its support."""
        done: list[str] = []
        waiting = list(self._assets)
        while waiting:
            ready = [name for name in waiting if self._support(name) in (None, *done)]
            if not ready:
                raise MemobenchError(
                    f"task {self._task.name}: {', '.join(waiting)} support each other in a cycle; check its :init"
                )
            done += ready
            waiting = [name for name in waiting if name not in ready]
        return done

    def _support(self, name: str) -> str | None:
        """Return the instance that supports or contains ``name``; None for the table."""
        place = self._places[name].args[1]
        if place in self._assets:
            return place
        region = self._task.regions.get(place)
        if region is not None and region.target == TABLE:
            return None
        owners = [other for other in self._assets if place.startswith(f"{other}_")]
        if not owners:
            raise MemobenchError(f"task {self._task.name}: {name!r} starts at {place!r}, which is no region or object")
        return max(owners, key=len)

    def _joints(self) -> dict[str, float]:
        """Return initial joint positions: closed and off unless an `init` atom differs."""
        wanted = {atom.args[0]: atom.predicate for atom in self._task.init if len(atom.args) == 1}
        joints = {}
        for name, asset in self._assets.items():
            for region, articulation in asset.articulations.items():
                state = wanted.get(f"{name}_{region}" if region else name, "close")
                opened = state in ("open", "turnon")
                joints[articulation.joint] = articulation.open_q if opened else articulation.closed_q
        return joints

    def place(self, seed: int, draw: int = 0) -> Placement:
        """Sample a placement of a seed; see `draw`. Further ones have the numbers 1, 2, …"""
        return self.draw(
            np.random.default_rng([seed, zlib.crc32(self._task.scene_name.encode()), *([draw] if draw else [])])
        )

    def draw(self, rng: np.random.Generator) -> Placement:
        """Draw until there is no overlap; write the placement into model and data, and return it.

        Raises:
            MemobenchError: each of `MAX_DRAWS` draws has an overlap.
        """
        pair = ("", "")
        for _ in range(MAX_DRAWS):
            placement = self._draw_once(rng)
            write(placement, self._model, self._data, self._assets)
            overlap = self._overlap()
            if overlap is None:
                return placement
            pair = overlap
        raise MemobenchError(
            f"task {self._task.name}: {pair[0]} and {pair[1]} overlapped in each of {MAX_DRAWS} draws of the initial "
            "state; move their regions apart"
        )

    def _draw_once(self, rng: np.random.Generator) -> Placement:
        joints = self._joints()
        poses: dict[str, Pose] = {}
        for name in self._order:
            asset, atom = self._assets[name], self._places[name]
            support = self._support(name)
            if support is None:
                poses[name] = self._on_table(
                    self._task.regions[atom.args[1]], TABLE_TOP - asset.bottom + DROP_HEIGHT, rng
                )
            elif atom.args[1] == support:
                below, above = poses[support], np.empty(3)
                height = self._assets[support].supports - asset.bottom + DROP_HEIGHT
                mujoco.mju_rotVecQuat(above, [0.0, 0.0, height], below[3:])
                poses[name] = np.concatenate([below[:3] + above, below[3:]])
            else:
                poses[name] = self._on_site(name, atom, poses, joints, rng)
        return Placement(poses, joints)

    def _on_table(self, region: Region, height: float, rng: np.random.Generator) -> Pose:
        """Draw a pose uniformly from a random range of a region."""
        x1, y1, x2, y2 = region.ranges[int(rng.integers(len(region.ranges)))]
        x, y, yaw = rng.uniform(x1, x2), rng.uniform(y1, y2), rng.uniform(*region.yaw)
        # numpy's sine and cosine differ in the last bit between processors.
        return np.array([x, y, height, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)])

    def _on_site(
        self, name: str, atom: Atom, poses: dict[str, Pose], joints: dict[str, float], rng: np.random.Generator
    ) -> Pose:
        """Draw a pose on top of a fixture's site, or on the floor of its region for `In`."""
        asset = self._assets[name]
        write(Placement(poses, joints), self._model, self._data, self._assets)
        site = self._model.site(atom.args[1]).id
        half = self._model.site_size[site]
        rotation = self._data.site_xmat[site].reshape(3, 3)
        room = np.maximum(half[:2] - asset.radius, 0.0)
        x, y = rng.uniform(-room, room)
        z = (-half[2] if atom.predicate == "in" else half[2]) - asset.bottom + DROP_HEIGHT
        position = self._data.site_xpos[site] + rotation @ np.array([x, y, z])
        return np.concatenate([position, [1.0, 0.0, 0.0, 0.0]])

    def _overlap(self) -> tuple[str, str] | None:
        """Return the names of the first two overlapping bodies."""
        mujoco.mj_collision(self._model, self._data)
        for contact in self._data.contact[: self._data.ncon] if self._data.ncon else ():
            if contact.dist < -MAX_CONTACT_DEPTH:
                bodies = [self._model.geom_bodyid[geom] for geom in contact.geom]
                roots = [self._model.body(self._model.body_rootid[body]).name for body in bodies]
                return roots[0], roots[1]
        return None


def write(placement: Placement, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]) -> None:
    """Write a placement into a model (fixtures) and data (objects, joints); keep velocities."""
    for name, pose in placement.poses.items():
        body = model.body(name)
        if assets[name].kind == "fixture":
            model.body_pos[body.id], model.body_quat[body.id] = pose[:3], pose[3:]
        else:
            address = int(model.joint(f"{name}_joint0").qposadr[0])
            data.qpos[address : address + 7] = pose
    for joint, q in placement.joints.items():
        data.qpos[int(model.joint(joint).qposadr[0])] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
