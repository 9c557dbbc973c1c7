"""What could be seen now, as objects instead of pixels: class, pose, joint and highlight of each visible thing.

The observation is a fixed number of slots, flat, float32. A slot is an object, a fixture, or a moving part of a fixture
(a drawer, a door, a knob). Slots hold only what a camera of the benchmark sees at this moment:
rays run from both cameras to points of each thing, and what none of them reaches is absent. They carry no identity:
they are sorted by class and place, so exchanging two equal objects changes nothing; and no goal, progress or history.

LIBERO's three drawers have one origin, their cabinet's. There a drawer is where its handle is, and a cabinet's drawers
follow one another from the top, pulled or not. Their heights show as much, so this order adds nothing.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, get_args, get_type_hints

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.assets.asset import Articulation
from lerobot_memobench.sim.assets.registry import known_classes, split_class
from lerobot_memobench.sim.object_layout import FIELDS, SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation

POINTS = 24
"""Points of a thing to which rays run."""
QUANTUM = 1e-4
"""Poses are told to 0.1 mm (rotations and angles to 1e-4): a drawer that holds something rests a nanometre from an
empty one, and a difference like that would say what is inside, or change the order of slots."""
VISIBLE_POINTS = 2
"""Rays that must arrive: one may slip through a gap between drawer and frame."""
TURNS = (slice(0, 3), slice(3, 8), slice(8, POINTS))
"""Which points of a thing are tried in turn, by each camera, until so many rays have arrived."""

Array = NDArray[np.float64]


@cache
def classes() -> tuple[str, ...]:
    """Return the names of the classes, in order of their indices: kinds of moving parts, then objects and fixtures."""
    return (*get_args(get_type_hints(Articulation)["kind"]), *known_classes())


def layout() -> dict[str, Any]:
    """Return how to read the observation: ``slots``, ``fields`` (name, start, size) and ``classes``."""
    fields = [{"name": name, "start": STARTS[name], "size": size} for name, size in FIELDS.items()]
    return {"slots": SLOTS, "fields": fields, "classes": list(classes())}


NORMALS = (None,) if "normal:" in str(mujoco.mj_multiRay.__doc__) else ()
"""Where MuJoCo's rays write the normals of what they hit; versions until 3.4 have no such argument."""


@dataclass(frozen=True)
class Thing:
    """What one slot may show.

    Attributes:
        kind: index of its class. body: whose pose it has. joint: address of its joint in qpos, None without one.
        site: whose position it has instead of the body's, None where it has the body's.
        ordered_by: the body by whose position it is sorted.
    """

    kind: int
    body: int
    joint: int | None
    site: int | None
    ordered_by: int


class ObjectSlots:
    """Look at one simulation as slots.

    Attributes:
        things: all that may be seen: each object and fixture, followed by its moving parts.

    Raises:
        MemobenchError: the scene holds more things than there are slots, or one of a class that is not registered.
    """

    def __init__(self, sim: Simulation) -> None:
        self._sim = sim
        self.things: list[Thing] = []
        self._owner = np.full(sim.model.nbody, -1)
        for name, asset in sim.assets.items():
            root = sim.model.body(name).id
            self._add(Thing(number(split_class(asset.class_name)[0]), root, None, None, root))
            for part in asset.articulations.values():
                joint = sim.model.joint(part.joint)
                body = int(sim.model.jnt_bodyid[joint.id])
                site = sim.model.site(part.handle_site).id if part.shares_origin else None
                ordered_by = root if part.shares_origin else body
                self._add(Thing(number(part.kind), body, int(joint.qposadr[0]), site, ordered_by))
        if len(self.things) > SLOTS:
            raise MemobenchError(
                f"task {sim.task.name} has {len(self.things)} objects and moving parts, more than the {SLOTS} that "
                "an object observation holds; use env.obs_type=pixels_agent_pos"
            )
        for body in range(1, sim.model.nbody):  # parents go first: what hangs on a thing belongs to it
            if self._owner[body] < 0:
                self._owner[body] = self._owner[sim.model.body_parentid[body]]
        self._points = np.concatenate([self._surface(index, thing.body) for index, thing in enumerate(self.things)])
        self._bodies = np.repeat([thing.body for thing in self.things], POINTS)
        self._numbers = np.arange(len(self._points)).reshape(-1, POINTS)  # of a thing's points
        self._cameras = [sim.model.camera(name).id for name in MJCF_CAMERAS.values()]
        self._group = np.zeros(6, np.uint8)
        self._group[sim.opaque_group] = 1

    def owners(self, geoms: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the index in `things` that each geom belongs to, for ids of any shape; -1 for none and for id -1."""
        return np.where(geoms >= 0, self._owner[self._sim.model.geom_bodyid[geoms]], -1)

    def observe(self) -> NDArray[np.float32]:
        """Return the slots (SIZE,) of what is visible in the present state."""
        seen = self._visible()
        things = [thing for thing, visible in zip(self.things, seen, strict=True) if visible]
        rows = np.array([self._row(thing) for thing in things]).reshape(-1, WIDTH)
        return in_slots(rows, rounded(self._sim.data.xpos[[thing.ordered_by for thing in things]]))

    def _add(self, thing: Thing) -> None:
        self._owner[thing.body] = len(self.things)
        self.things.append(thing)

    def _surface(self, index: int, body: int) -> Array:
        """Return POINTS points of a thing's opaque geoms, far apart, a little inside, in its body's frame."""
        model = self._sim.model
        found = []
        for geom in np.flatnonzero(
            (self._owner[model.geom_bodyid] == index) & (model.geom_group == self._sim.opaque_group)
        ):
            points = corners(model, geom)
            points = points @ rotation(model.geom_quat[geom]).T + model.geom_pos[geom]
            inner = model.geom_bodyid[geom]
            while inner != body:
                points = points @ rotation(model.body_quat[inner]).T + model.body_pos[inner]
                inner = model.body_parentid[inner]
            found.append(points)
        points = spread(np.concatenate(found), POINTS)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        return middle + 0.94 * (points - middle)

    def _visible(self) -> NDArray[np.bool_]:
        """Return for each thing whether a camera sees it."""
        model, data = self._sim.model, self._sim.data
        frames = data.xmat[self._bodies].reshape(-1, 3, 3)
        targets = np.einsum("nij,nj->ni", frames, self._points) + data.xpos[self._bodies]
        hits = np.zeros(len(self.things), dtype=int)
        for turn, camera in product(TURNS, self._cameras):
            tried = self._numbers[hits < VISIBLE_POINTS, turn].ravel()
            origin = data.cam_xpos[camera].copy()
            rays = targets[tried] - origin
            inside = in_picture(rays @ data.cam_xmat[camera].reshape(3, 3), float(model.cam_fovy[camera]))
            count = int(inside.sum())
            if not count:
                continue
            geoms, distances = np.full(count, -1, np.int32), np.zeros(count)
            mujoco.mj_multiRay(
                model, data, origin, rays[inside].ravel(), self._group, True, -1, geoms, distances, *NORMALS, count,
                mujoco.mjMAXVAL,
            )  # fmt: skip
            owners, mine = self.owners(geoms), tried[inside] // POINTS
            hits += np.bincount(mine[owners == mine], minlength=len(hits))
        return hits >= VISIBLE_POINTS

    def _row(self, thing: Thing) -> Array:
        data = self._sim.data
        position = data.xpos[thing.body] if thing.site is None else data.site_xpos[thing.site]
        turned = data.xmat[thing.body].reshape(3, 3)
        joint = 0.0 if thing.joint is None else data.qpos[thing.joint]
        lit = float(is_lit(position, self._sim.highlights))
        pose = rounded(np.array([*position, *turned[:, 0], *turned[:, 1], joint]))
        return np.array([1.0, thing.kind, *pose, lit]) + 0.0  # no negative zeros


def is_lit(position: Array, highlights: Iterable[Highlight]) -> bool:
    """Whether what stands at a position (3,) stands in a highlight."""
    return any(np.hypot(*(position[:2] - np.array(mark.position[:2]))) < mark.radius for mark in highlights)


def number(kind: str) -> int:
    """Return the index of a class.

    Raises:
        MemobenchError: there is none of that name.
    """
    if kind not in classes():
        raise MemobenchError(f"object observations know no class {kind!r}; use env.obs_type=pixels_agent_pos")
    return classes().index(kind)


def rounded(values: Array) -> Array:
    """Return values as multiples of QUANTUM."""
    return np.round(values / QUANTUM) * QUANTUM


def in_slots(things: Array, places: Array | None = None) -> NDArray[np.float32]:
    """Return things (n, WIDTH) as an observation (SIZE,): in the order of class and place, before empty slots.

    ``places`` (n, 3): None for where the things are. Of one class and place they stay in the order given.
    """
    slots = np.zeros((SLOTS, WIDTH), np.float32)
    start = STARTS["position"]
    x, y, z = (things[:, start : start + 3] if places is None else places).T
    slots[: len(things)] = things[np.lexsort((z, y, x, things[:, STARTS["class"]]))]
    return slots.reshape(-1)


def rotation(quaternion: Array) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion wxyz."""
    matrix = np.empty(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def corners(model: mujoco.MjModel, geom: int) -> Array:
    """Return points (n, 3) on a geom's surface in its frame: a mesh's vertices, else the corners of its box."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], dtype=np.float64)
    middle, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return np.asarray(middle + signs * half)


def spread(points: Array, count: int) -> Array:
    """Return ``count`` of the points (n, 3), each the farthest from those before; repeated where there are fewer."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def in_picture(rays: Array, fovy: float) -> NDArray[np.bool_]:
    """Return which rays (n, 3), in a camera's frame (it looks along -z), fall into its square picture."""
    edge = -rays[:, 2] * np.tan(np.radians(fovy) / 2)
    return (np.abs(rays[:, 0]) < edge) & (np.abs(rays[:, 1]) < edge)
