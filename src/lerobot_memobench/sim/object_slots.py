"""Observe the visible objects instead of pixels: class, pose, joint and highlight of each.

The observation is a flat float32 vector of a fixed number of slots. A slot is an object, a fixture, or a moving part of
a fixture (drawer, door, knob), called *thing* here. Only things visible to a camera of the benchmark in the present
state are included: rays run from both cameras to points of each thing. Slots are sorted by class and position, so they
carry no identity: exchanging two equal objects has no effect. They contain no goal, progress or history.

LIBERO's three drawers share the origin of their cabinet. There the position of a drawer is its handle's, and drawers
are sorted by height of the closed handles, from the top. The observed heights contain the same information.
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
from lerobot_memobench.sim.asset import COLLISION_GROUP, Articulation, split_class
from lerobot_memobench.sim.mjcf import known_classes
from lerobot_memobench.sim.object_layout import FIELDS, SLOTS, STARTS, WIDTH
from lerobot_memobench.sim.placement import quaternion_matrix
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from mujoco_raster.highlights import Highlight

POINTS_PER_THING = 24  # ray targets per thing
POSE_RESOLUTION = 1e-4
"""Resolution of poses, m and rad. A drawer with content rests a nanometre from an empty one; without rounding the
difference would reveal the content or change the order of slots."""
MIN_VISIBLE_POINTS = 2
"""Smallest number of unobstructed rays; a single one may pass through a gap between drawer and frame."""
POINT_BATCHES = (slice(0, 3), slice(3, 8), slice(8, POINTS_PER_THING))
"""Batches of points, cast in turn from each camera until `MIN_VISIBLE_POINTS` are visible."""

Array = NDArray[np.float64]


@cache
def classes() -> tuple[str, ...]:
    """Return the class names in order of their indices: kinds of moving parts, then objects and fixtures."""
    return (*get_args(get_type_hints(Articulation)["kind"]), *known_classes())


def layout() -> dict[str, Any]:
    """Return the layout of the observation: ``slots``, ``fields`` (name, start, size) and ``classes``."""
    fields = [{"name": name, "start": STARTS[name], "size": size} for name, size in FIELDS.items()]
    return {"slots": SLOTS, "fields": fields, "classes": list(classes())}


_NORMALS_ARGUMENT = (None,) if "normal:" in str(mujoco.mj_multiRay.__doc__) else ()
"""Argument of `mujoco.mj_multiRay` for surface normals; versions up to 3.4 do not have it."""


@dataclass(frozen=True)
class Thing:
    """An object, a fixture, or a moving part of a fixture."""

    kind: int  # index of its class
    body: int  # id of the body that defines its pose
    joint: int | None  # address of its joint in qpos, None without one
    site: int | None  # id of the site that defines its position, None for the body's
    ordered_by: int  # id of the body whose position sorts it


class ObjectSlots:
    """Compute object observations of one simulation.

    ``things``: all things of the scene: each object and fixture, followed by its moving parts.
    """

    def __init__(self, sim: Simulation) -> None:
        self._sim = sim
        self.things: list[Thing] = []
        self._owner = np.full(sim.model.nbody, -1)
        for name, asset in sim.assets.items():
            root = sim.model.body(name).id
            self._add(Thing(_class_index(split_class(asset.class_name)[0]), root, None, None, root))
            for part in asset.articulations.values():
                joint = sim.model.joint(part.joint)
                body = int(sim.model.jnt_bodyid[joint.id])
                site = sim.model.site(part.handle_site).id if part.shares_origin else None
                ordered_by = root if part.shares_origin else body
                self._add(Thing(_class_index(part.kind), body, int(joint.qposadr[0]), site, ordered_by))
        if len(self.things) > SLOTS:
            raise MemobenchError(
                f"task {sim.task.name} has {len(self.things)} objects and moving parts, more than the {SLOTS} slots of "
                "an object observation; use env.obs_type=pixels_agent_pos"
            )
        for body in range(1, sim.model.nbody):  # parents precede children, which inherit the owner
            if self._owner[body] < 0:
                self._owner[body] = self._owner[sim.model.body_parentid[body]]
        self._points = np.concatenate([self._surface(index, thing.body) for index, thing in enumerate(self.things)])
        self._bodies = np.repeat([thing.body for thing in self.things], POINTS_PER_THING)
        self._point_indices = np.arange(len(self._points)).reshape(-1, POINTS_PER_THING)
        self._cameras = [sim.model.camera(name).id for name in MJCF_CAMERAS.values()]
        self._group = np.zeros(6, np.uint8)
        self._group[COLLISION_GROUP] = 1

    def owners(self, bodies: NDArray[np.integer]) -> NDArray[np.int64]:
        """Return the index in `things` of each body's owner, for ids of any shape; -1 without owner and for id -1."""
        return np.where(bodies >= 0, self._owner[bodies], -1)

    def observe(self) -> NDArray[np.float32]:
        """Return the observation (SIZE,) of the present state."""
        absent = {self._sim.model.body(name).id for name in self._sim.absent}
        shown = zip(self.things, self._visible(), strict=True)
        things = [thing for thing, visible in shown if visible and thing.body not in absent]
        rows = np.array([self._row(thing) for thing in things]).reshape(-1, WIDTH)
        return fill_slots(rows, _rounded(self._sim.data.xpos[[thing.ordered_by for thing in things]]))

    def position(self, thing: Thing) -> Array:
        """Return the position (3,) of a thing in the world, m: of its origin, or of its handle if it has a site."""
        data = self._sim.data
        return np.asarray(data.xpos[thing.body] if thing.site is None else data.site_xpos[thing.site])

    def _add(self, thing: Thing) -> None:
        self._owner[thing.body] = len(self.things)
        self.things.append(thing)

    def _surface(self, index: int, body: int) -> Array:
        """Return `POINTS_PER_THING` distant points slightly inside a thing's opaque geoms, in its body's frame."""
        model = self._sim.model
        surfaces = []
        for geom in np.flatnonzero((self._owner[model.geom_bodyid] == index) & (model.geom_group == COLLISION_GROUP)):
            points = _geom_points(model, geom)
            points = points @ quaternion_matrix(model.geom_quat[geom]).T + model.geom_pos[geom]
            inner = model.geom_bodyid[geom]
            while inner != body:
                points = points @ quaternion_matrix(model.body_quat[inner]).T + model.body_pos[inner]
                inner = model.body_parentid[inner]
            surfaces.append(points)
        points = _farthest(np.concatenate(surfaces), POINTS_PER_THING)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        return middle + 0.94 * (points - middle)

    def _visible(self) -> NDArray[np.bool_]:
        model, data = self._sim.model, self._sim.data
        frames = data.xmat[self._bodies].reshape(-1, 3, 3)
        targets = np.einsum("nij,nj->ni", frames, self._points) + data.xpos[self._bodies]
        hits = np.zeros(len(self.things), dtype=int)
        for batch, camera in product(POINT_BATCHES, self._cameras):
            tried = self._point_indices[hits < MIN_VISIBLE_POINTS, batch].ravel()
            origin = data.cam_xpos[camera].copy()
            rays = targets[tried] - origin
            inside = _in_image(rays @ data.cam_xmat[camera].reshape(3, 3), float(model.cam_fovy[camera]))
            count = int(inside.sum())
            if not count:
                continue
            geoms, distances = np.full(count, -1, np.int32), np.zeros(count)
            mujoco.mj_multiRay(
                model, data, origin, rays[inside].ravel(), self._group, True, -1, geoms, distances,
                *_NORMALS_ARGUMENT, count, mujoco.mjMAXVAL,
            )  # fmt: skip
            owners = self.owners(np.where(geoms >= 0, model.geom_bodyid[geoms], -1))
            aimed_at = tried[inside] // POINTS_PER_THING
            hits += np.bincount(aimed_at[owners == aimed_at], minlength=len(hits))
        return hits >= MIN_VISIBLE_POINTS

    def _row(self, thing: Thing) -> Array:
        data = self._sim.data
        position = self.position(thing)
        rotation = data.xmat[thing.body].reshape(3, 3)
        joint = 0.0 if thing.joint is None else data.qpos[thing.joint]
        lit = float(is_lit(position, self._sim.highlights))
        pose = _rounded(np.array([*position, *rotation[:, 0], *rotation[:, 1], joint]))
        return np.array([1.0, thing.kind, *pose, lit]) + 0.0  # no negative zeros


def is_lit(position: Array, highlights: Iterable[Highlight]) -> bool:
    """Return whether a position (3,) is inside a highlight."""
    return any(np.hypot(*(position[:2] - np.array(mark.position[:2]))) < mark.radius for mark in highlights)


def _class_index(kind: str) -> int:
    if kind not in classes():
        raise MemobenchError(
            f"class {kind!r} is not available in object observations; use env.obs_type=pixels_agent_pos"
        )
    return classes().index(kind)


def _rounded(values: Array) -> Array:
    return np.round(values / POSE_RESOLUTION) * POSE_RESOLUTION


def fill_slots(things: Array, places: Array | None = None) -> NDArray[np.float32]:
    """Return rows (n, WIDTH) as an observation (SIZE,): sorted by class and position, followed by empty slots.

    ``places`` (n, 3): positions used for sorting, by default those of the rows. The sort is stable.
    """
    slots = np.zeros((SLOTS, WIDTH), np.float32)
    start = STARTS["position"]
    x, y, z = (things[:, start : start + 3] if places is None else places).T
    slots[: len(things)] = things[np.lexsort((z, y, x, things[:, STARTS["class"]]))]
    return slots.reshape(-1)


def _geom_points(model: mujoco.MjModel, geom: int) -> Array:
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        return np.asarray(model.mesh_vert[first : first + model.mesh_vertnum[mesh]], dtype=np.float64)
    middle, half = model.geom_aabb[geom][:3], model.geom_aabb[geom][3:]
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    return np.asarray(middle + signs * half)


def _farthest(points: Array, count: int) -> Array:
    """Return ``count`` of the points (n, 3), each the farthest from its predecessors; repeat if there are fewer."""
    chosen = [int(np.argmax(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    while len(chosen) < count:
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return points[chosen]


def _in_image(rays: Array, fovy: float) -> NDArray[np.bool_]:
    edge = -rays[:, 2] * np.tan(np.radians(fovy) / 2)
    return (np.abs(rays[:, 0]) < edge) & (np.abs(rays[:, 1]) < edge)
