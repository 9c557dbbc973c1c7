"""Sample placements with LIBERO's sequence of `RandomState` draws, so that a seed reproduces LIBERO's scene.

Episode k of the paper's evaluation has seed 7 + k. All draws of a scene come from one `RandomState`, in this order:

1. seven normal numbers, the arm's noise, which LIBERO multiplies by zero;
2. for each (Open|Close|TurnOn|TurnOff x) of `:init`, a position of its joints, in two rounds, the second one is used:
   LIBERO's environment loads the model at its creation and at its reset;
3. for each (On x <region of the table>) of `:init`: a range, x and y, repeated while the object overlaps placed ones,
   then the angles of its rotations;
4. the same for (On x <region of a fixture>), then (In x <region>), then (On x <object>).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.asset import Asset, Turn, arena_of
from lerobot_memobench.sim.mjcf import ClassFile, class_file
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

MAX_DRAWS = 5000  # maximum number of draws of a position
MODEL_LOADS = 2  # number of times LIBERO loads the model until the end of the first reset
OBJECT_DROP_HEIGHT = 0.01  # initial height of an object above the table or another object, m

Array = NDArray[np.float64]
Rectangle = tuple[float, float, float, float]  # x1, y1, x2, y2, m
CENTRE_ONLY: Rectangle = (0.0, 0.0, 0.0, 0.0)
Pose = NDArray[np.float64]  # position and quaternion wxyz, (7,)


class Placer:
    """Place fixtures and objects of one simulation by the `init` atoms of its task."""

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        self._task, self._model, self._data, self._assets = task, model, data, assets
        self._arena = arena_of(task)
        self._placing = {atom.args[0]: atom for atom in task.init if atom.predicate in ("on", "in")}
        for name in assets:
            if name not in self._placing:
                advice = f"add (On {name} <region>) to its :init"
                raise MemobenchError(f"task {task.name} has no start for {name!r}; {advice}")
        self._files = {name: class_file(asset.class_name, task.suite) for name, asset in assets.items()}

    def place(self, seed: int, draw: int = 0) -> None:
        """Sample a placement of a seed and write it into model (fixtures) and data (objects, joints).

        Raises:
            MemobenchError: a region has no free space for its object.
        """
        # Draw 0 is LIBERO's, the stream of its own `np.random.seed`.
        rng = np.random.RandomState([seed, draw] if draw else seed)
        rng.randn(7)
        joints = self._draw_joints(rng)
        # LIBERO reads the positions of regions while fixtures are at the origin.
        still = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        self._write({name: still for name, asset in self._assets.items() if asset.kind == "fixture"}, joints)
        poses: dict[str, Pose] = {}
        for atom in sorted(self._placing.values(), key=self._rank):
            poses[atom.args[0]] = self._draw(atom, poses, rng)
        self._write(poses, joints)

    def _write(self, poses: Mapping[str, Pose], joints: Mapping[str, float]) -> None:
        model, data = self._model, self._data
        for name, pose in poses.items():
            if self._assets[name].kind == "fixture":
                body = model.body(name).id
                model.body_pos[body], model.body_quat[body] = pose[:3], pose[3:]
            else:
                address = int(model.joint(f"{name}_joint0").qposadr[0])
                data.qpos[address : address + 7] = pose
        for joint, q in joints.items():
            data.qpos[int(model.joint(joint).qposadr[0])] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)

    def _rank(self, atom: Atom) -> int:
        """Return LIBERO's order of placing: on the table, on fixtures, in regions, on objects."""
        if atom.args[1] in self._assets:
            return 3
        if atom.predicate == "in":
            return 2
        return 1 if self._task.regions[atom.args[1]].target in self._assets else 0

    # --- joints ---

    def _draw_joints(self, rng: np.random.RandomState) -> dict[str, float]:
        """Draw the positions of joints in `:init`; other joints are zero."""
        joints = {part.joint: 0.0 for asset in self._assets.values() for part in asset.articulations.values()}
        for _ in range(MODEL_LOADS):
            for atom in self._task.init:
                if len(atom.args) == 1:
                    ranges = self._joint_ranges(atom)
                    low, high = next(iter(ranges.values()))
                    joints.update(dict.fromkeys(ranges, rng.uniform(low, high)))
        return joints

    def _joint_ranges(self, atom: Atom) -> dict[str, tuple[float, float]]:
        """Return joint -> range of an atom's predicate, for all parts of a fixture or the part of a region."""
        ranges = {
            part.joint: part.ranges[atom.predicate]
            for instance, asset in self._assets.items()
            for region, part in asset.articulations.items()
            if atom.args[0] in (instance, f"{instance}_{region}") and atom.predicate in part.ranges
        }
        if not ranges:
            raise MemobenchError(f"task {self._task.name}: {atom} of :init applies to no joint")
        return ranges

    # --- places ---

    def _draw(self, atom: Atom, poses: Mapping[str, Pose], rng: np.random.RandomState) -> Pose:
        """Draw a free position and then the rotation for a placing atom."""
        name, where = atom.args
        rectangles, base = self._room(atom, poses)
        # LIBERO ignores overlaps of fixtures and of objects on objects.
        alone = self._assets[name].kind == "fixture" or where in self._assets
        obstacles = {} if alone else poses
        known, z = self._files[name], base[2] - self._files[name].bottom
        for _ in range(MAX_DRAWS):
            x1, y1, x2, y2 = rectangles[rng.randint(len(rectangles))]
            position = rng.uniform(x1, x2) + base[0], rng.uniform(y1, y2) + base[1], z
            if all(_is_clear_of(known, position, self._files[obstacle], obstacles[obstacle]) for obstacle in obstacles):
                if self._assets[name].kind == "fixture":
                    low, high = sorted(self._task.regions[where].yaw)
                    return np.array([*position, *_quaternion("z", rng.uniform(low, high))])
                return np.array([*position, *sample_orientation(known.turns, rng)])
        raise MemobenchError(
            f"task {self._task.name}: {name} overlapped with another object in each of {MAX_DRAWS} draws of its "
            "position; move the regions of its :init apart"
        )

    def _room(self, atom: Atom, poses: Mapping[str, Pose]) -> tuple[Sequence[Rectangle], Array]:
        """Return the ranges of x and y, and their origin (3,) with the height of the underside."""
        name, where = atom.args
        if where in self._assets:
            if where not in poses:
                raise MemobenchError(
                    f"task {self._task.name}: {where!r} has no place yet; put it before {name!r} in :init"
                )
            return [CENTRE_ONLY], poses[where][:3] + np.array([0.0, 0.0, self._files[where].top + OBJECT_DROP_HEIGHT])
        region = self._task.regions[where]
        if region.target not in self._assets:
            x, y, z = self._arena.origin
            if self._assets[name].kind == "fixture":
                return region.ranges, np.array([x, y, z + self._arena.fixture_drop])
            r = self._files[name].radius if self._arena.inset else 0.0
            ranges = [(x1 + r, y1 + r, x2 - r, y2 - r) for x1, y1, x2, y2 in region.ranges]
            return ranges, np.array([x, y, z + OBJECT_DROP_HEIGHT])
        site, owner = self._model.site(where).id, poses[region.target]
        base = owner[:3] + _single_precision_matrix(owner[3:]) @ self._data.site_xpos[site]
        if atom.predicate == "in":
            return [CENTRE_ONLY], base
        # As in LIBERO, half the region, reduced by the object's radius.
        x, y = self._model.site_size[site][:2] / 2 - self._files[name].radius
        return [(-x, -y, x, y)], base + np.array([0.0, 0.0, self._files[region.target].top])


def _is_clear_of(thing: ClassFile, position: tuple[float, float, float], other: ClassFile, pose: Pose) -> bool:
    distance = np.hypot(position[0] - pose[0], position[1] - pose[1])
    return bool(distance > other.radius + thing.radius or position[2] - pose[2] > other.top - thing.bottom)


# --- turns ---


def _quaternion(axis: str, angle: float) -> Array:
    q = np.zeros(4)
    q[0], q[1 + "xyz".index(axis)] = np.cos(angle / 2), np.sin(angle / 2)
    return q


def sample_orientation(turns: tuple[Turn, ...], rng: np.random.RandomState) -> Array:
    """Draw an object's quaternion (4,) as LIBERO."""
    # LIBERO's sampler writes (x, y, z, w), but its reader expects (w, x, y, z): a rotation of 90° about x becomes one
    # about z.
    drawn = [np.roll(_quaternion(axis, rng.uniform(low, high)), -1) for axis, low, high in turns]
    if len(drawn) == 1:
        return drawn[0]
    q = np.array([0.0, 0.0, 0.0, 1.0])  # several rotations are multiplied in single precision
    for x1, y1, z1, w1 in drawn:
        x0, y0, z0, w0 = q
        q = np.array(
            (
                x1 * w0 + y1 * z0 - z1 * y0 + w1 * x0,
                -x1 * z0 + y1 * w0 + z1 * x0 + w1 * y0,
                x1 * y0 - y1 * x0 + z1 * w0 + w1 * z0,
                -x1 * x0 - y1 * y0 - z1 * z0 + w1 * w0,
            ),
            dtype=np.float32,
        )
    return q.astype(np.float64)


def quaternion_matrix(q: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion wxyz."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, q)
    return matrix.reshape(3, 3)


def _single_precision_matrix(q: Array) -> NDArray[np.float32]:
    """Return the rotation (3, 3) of a quaternion wxyz as robosuite computes it, in single precision."""
    q = np.asarray(q, dtype=np.float32)
    q = q * np.float32(np.sqrt(2.0 / np.dot(q, q)))
    product = np.outer(q, q)
    (_, wx, wy, wz), (_, xx, xy, xz), (_, _, yy, yz), (_, _, _, zz) = product
    one = np.float32(1.0)
    rows = [one - yy - zz, xy - wz, xz + wy], [xy + wz, one - xx - zz, yz - wx], [xz - wy, yz + wx, one - xx - yy]
    return np.array(rows)
