"""Evaluate the atoms of the task language on the simulator's state.

`World` evaluates predicates of the present state with LIBERO's semantics (paper, section 3.1). `StartState` evaluates
predicates that compare the present state with the start of the execution. `HiddenObjects` removes objects from a scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isnan
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim import robot
from lerobot_memobench.sim.asset import COLLISION_GROUP, TABLE, Articulation, Asset
from lerobot_memobench.sim.scene import DEAD_CENTRE
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task

Array = NDArray[np.float64]

ON_DISTANCE = 0.03  # horizontal distance of origins below which one object counts as on another, m
IN_SLACK = 0.01  # distance below a region's lower bound at which an origin still counts as inside, m
ON_SITE_BELOW, ON_SITE_ABOVE = 0.005, 0.10
"""Distances below and above a site's top between which an origin counts as on it, m."""

DETENT_DISTANCE = 0.02
"""Largest distance of the grip site from home for the detent, m; twice the error of learned policies."""
DETENT_ANGLE = 0.1  # largest rotation of the hand from home for the detent, rad
DETENT_OPENING = 0.01
"""Largest distance of each finger from home for the detent, m; excludes a hand that holds an object."""
DETENT_SPEED = (0.03, 0.15)
"""Largest speed of the hand for the detent, m/s and rad/s; learned policies hover at 2 cm/s. An action of 0.2 leaves
the detent in one step."""
SAME_STATE = 1e-4
"""Largest difference of positions and velocities (m, rad, m/s, rad/s) between equal states; states in files are
rounded."""
PLACE_DISTANCE = 0.01  # largest distance of an object in place from its start, m; two pixels
LIFTED_HEIGHT = 0.02  # height above its start from which an object is lifted, m; more than a push raises it
DETENT_SHIFT, DETENT_TURN = 0.001, 0.02
"""Largest distance (m) and angle (rad) of an object from its start for the detent to restore it."""


class World:
    """Evaluate predicates of the present state of one simulation.

    The formulas are those of LIBERO's `site_object.py` and `base_object_states.py`: `On` a region of the table needs no
    contact, and only geoms of robosuite's collision group count as contacts.
    Positions and contacts must match the present state (after `mujoco.mj_step1` or `mujoco.mj_forward`).

    Attributes:
        joints: name in atoms -> articulation and address in qpos, of each drawer, door and knob.
    """

    def __init__(self, task: Task, model: mujoco.MjModel, data: mujoco.MjData, assets: dict[str, Asset]):
        self._task, self._model, self._data, self._assets = task, model, data, assets
        self._index = {name: index for index, name in enumerate([*assets, TABLE])}
        # Owner of each geom: the instance at the root of its body's tree, −1 for robot and room.
        roots = {model.body(name).id: self._index[name] for name in assets}
        self._owner = np.array([roots.get(int(root), -1) for root in model.body_rootid[model.geom_bodyid]])
        self._owner[[model.geom(geom).name.startswith(TABLE) for geom in range(model.ngeom)]] = self._index[TABLE]
        self._owner[model.geom_group != COLLISION_GROUP] = -1
        self.joints: dict[str, tuple[Articulation, int]] = {}
        for name, asset in assets.items():
            for region, articulation in asset.articulations.items():
                address = int(model.joint(articulation.joint).qposadr[0])
                self.joints[f"{name}_{region}" if region else name] = (articulation, address)

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom is true now; raise `MemobenchError` if the scene has no answer."""
        match atom.predicate:
            case "in":
                return self._in(*atom.args)
            case "on":
                a, b = atom.args
                return self._on_object(a, b) if b in self._assets else self._on_site(a, b)
            case "open" | "close" | "turnon" | "turnoff":
                return self._articulated(atom.predicate, atom.args[0])
        raise MemobenchError(
            f"the simulator cannot answer {atom.predicate!r}; available: in, on, open, close, turnon, turnoff"
        )

    def touching(self, a: str, b: str) -> bool:
        """Return whether two instances (or an instance and the table) are in contact."""
        pair = {self._index[a], self._index[b]}
        if self._data.ncon == 0:
            return False
        owners = self._owner[self._data.contact.geom]
        return bool(np.any((owners[:, 0] != owners[:, 1]) & np.isin(owners, list(pair)).all(axis=1)))

    def articulation(self, name: str) -> tuple[Articulation, float]:
        """Return the articulation of a drawer, door or knob, and its position, m or rad."""
        if name not in self.joints:
            raise MemobenchError(
                f"{name!r} of task {self._task.name} cannot be opened or switched; {nearest(name, self.joints)}"
            )
        articulation, address = self.joints[name]
        return articulation, float(self._data.qpos[address])

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
        point, (position, rotation, size) = self._data.body(a).xpos, self._box_of(region)
        # LIBERO uses an axis-aligned box with half sides |R·size|, extended downwards by `IN_SLACK`.
        half = np.abs(rotation @ size)
        low, high = position - half, position + half
        low[2] -= IN_SLACK
        return bool(np.all(point > low) and np.all(point < high))

    def _on_object(self, a: str, b: str) -> bool:
        above = self._data.body(a).xpos - self._data.body(b).xpos
        if above[2] < 0 or float(np.hypot(above[0], above[1])) >= ON_DISTANCE:
            return False
        return self.touching(a, b)

    def _on_site(self, a: str, region: str) -> bool:
        position, rotation, size = self._box_of(region)
        # LIBERO applies the site's rotation where its inverse would be correct.
        offset = rotation @ (self._data.body(a).xpos - position)
        above = size[2] - ON_SITE_BELOW < offset[2] < size[2] + ON_SITE_ABOVE
        if not (above and np.all(np.abs(offset[:2]) < size[:2])):
            return False
        declared = self._task.regions.get(region)
        if declared is not None and declared.target not in self._assets:  # on the table no contact is needed
            return True
        return self.touching(a, max((name for name in self._assets if region.startswith(f"{name}_")), key=len))

    def _box_of(self, region: str) -> tuple[Array, Array, Array]:
        site = mujoco.mj_name2id(self._model, mujoco.mjtObj.mjOBJ_SITE, region)
        if site < 0:
            regions = [self._model.site(i).name for i in range(self._model.nsite)]
            raise MemobenchError(f"task {self._task.name} has no region {region!r}; {nearest(region, regions)}")
        data = self._data
        return data.site_xpos[site], data.site_xmat[site].reshape(3, 3), self._model.site_size[site]


class StartState:
    """Compare the present state with the start of the execution.

    A tolerance of poses could store a count between events. Strict scenes have none: a detent at home restores the arm
    (`in_detent`) and, if the scene is nearly in its start state (`nearly_as_begun`), the whole scene.

    The poses of ``data`` must match the present state. ``joints``: as of `World`.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        objects: Sequence[str],
        joints: Mapping[str, tuple[Articulation, int]],
    ) -> None:
        self._model, self._data = model, data
        self._grip = model.site(robot.GRIP_SITE).id
        arm = np.arange(robot.OTHERS.start)
        self._arm_indices = np.concatenate([arm, model.nq + arm])
        self._previous: Array | None = None
        self._bodies = {name: int(model.body(name).id) for name in objects}
        self._joints = joints
        self._places: dict[str, Array] = {}
        self._turns: dict[str, Array] = {}
        self.mark_hand()
        self.mark_scene()

    def mark_hand(self) -> None:
        """Store the arm's present state as home."""
        self._arm, self._previous = self._current_state()[self._arm_indices], None
        self._position, self._rotation, self._opening = self._hand()

    @property
    def home(self) -> tuple[Array, Array]:
        """Position (3,) and rotation (3, 3) of the grip site at home."""
        return self._position, self._rotation

    def mark_step(self, goes_on: bool = True) -> None:
        """Store the state at the beginning of a step: a hand that leaves home in the step still counts as home.

        ``goes_on``: whether the present state precedes the next one; False for a restore.
        """
        self._previous = self._current_state() if goes_on else None

    @property
    def goes_on(self) -> bool:
        """Whether the present state continues its predecessor."""
        return self._previous is not None

    def mark_scene(self) -> None:
        """Store the present state of the scene as the start of the execution."""
        self._start_state = self._current_state()
        self.mark_objects(self._bodies)

    def mark_objects(self, names: Iterable[str]) -> None:
        """Store the present poses of objects as their start."""
        for name in names:
            self._places[name] = self._data.xpos[self._bodies[name]].copy()
            self._turns[name] = self._data.xquat[self._bodies[name]].copy()

    def holds(self, atom: Atom) -> bool:
        """Return whether an atom of `SINCE_START` is true now."""
        match atom.predicate, atom.args:
            case "handhome", ():
                return self._is_or_was_equal(self._arm, self._arm_indices)
            case "asbegun", ():
                return self._is_or_was_equal(self._start_state)
            case "ajar", (name,):
                return self._is_ajar(name)
            case "lifted", (name,):
                return bool(self._data.xpos[self._bodies[name]][2] - self._places[name][2] > LIFTED_HEIGHT)
        (name,) = atom.args
        return self._shift(name) <= PLACE_DISTANCE

    def nearly_as_begun(self) -> bool:
        """Return whether all objects and joints are close enough to their start for the detent to restore them."""
        return not any(self.left_dead_centre(name) for name in self._joints) and all(
            self._shift(name) <= DETENT_SHIFT and self._turn(name) <= DETENT_TURN for name in self._bodies
        )

    def _is_or_was_equal(self, state: Array, part: Any = ...) -> bool:
        """Return whether part of the state equals ``state`` now or did at the beginning of the step."""
        states = [self._current_state()] if self._previous is None else [self._current_state(), self._previous]
        return any(bool(np.abs(one[part] - state).max() <= SAME_STATE) for one in states)

    def _is_ajar(self, name: str) -> bool:
        if name not in self._joints:
            raise MemobenchError(f"{name!r} cannot be opened or switched; {nearest(name, self._joints)}")
        joint, address = self._joints[name]
        q = float(self._data.qpos[address])
        open_or_on = q >= joint.on_at_least if joint.kind == "knob" else q < joint.open_below
        return self.left_dead_centre(name) and not open_or_on

    def left_dead_centre(self, name: str) -> bool:
        """Return whether a joint is farther from its start than its detent reaches."""
        joint, address = self._joints[name]
        return abs(float(self._data.qpos[address] - self._start_state[address])) > DEAD_CENTRE[joint.kind]

    def _shift(self, name: str) -> float:
        return float(np.linalg.norm(self._data.xpos[self._bodies[name]] - self._places[name]))

    def _turn(self, name: str) -> float:
        cosine = abs(float(self._data.xquat[self._bodies[name]] @ self._turns[name]))
        return 2.0 * float(np.arccos(min(cosine, 1.0)))

    def _current_state(self) -> Array:
        return np.append(self._data.qpos, self._data.qvel)

    def in_detent(self) -> bool:
        """Return whether the open hand is near home and at rest, so that the detent catches it."""
        velocity = np.empty(6)  # angular part first
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_SITE, self._grip, velocity, 0)
        speed, turning = np.linalg.norm(velocity[3:]), np.linalg.norm(velocity[:3])
        return self.at_detent() and bool(speed <= DETENT_SPEED[0] and turning <= DETENT_SPEED[1])

    def at_detent(self) -> bool:
        """Return whether the open hand is close enough to home for the detent, at any speed."""
        position, rotation, opening = self._hand()
        cosine = (np.trace(self._rotation.T @ rotation) - 1.0) / 2.0
        near = float(np.linalg.norm(position - self._position)) <= DETENT_DISTANCE
        level = float(np.arccos(np.clip(cosine, -1.0, 1.0))) <= DETENT_ANGLE
        return near and level and bool(np.all(np.abs(opening - self._opening) <= DETENT_OPENING))

    def _hand(self) -> tuple[Array, Array, Array]:
        data = self._data
        rotation = data.site_xmat[self._grip].reshape(3, 3).copy()
        return data.site_xpos[self._grip].copy(), rotation, data.qpos[robot.FINGERS].copy()


# --- hidden objects ---

PARKING_HEIGHT = 1000.0
"""Height of parked objects, m, plus 1 m times the body's number: outside the cameras' range, without contact."""


@dataclass(frozen=True, eq=False)
class HiddenObject:
    """An absent object."""

    name: str
    region: str  # region of its drawer
    offset: Array  # position relative to the region's site, (3,), m
    quaternion: Array  # orientation wxyz (4,)


class HiddenObjects:
    """Keep hidden objects outside a scene until their drawers open.

    An object that a prompt hides must not be observable, not even by a camera inside the shut drawer or by a drawer
    that moves otherwise. So it is parked far above the scene, at a position that is equal in all variants. The
    simulation is therefore bit-identical between variants until a drawer that contains an object is ajar.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        self._model, self._data = model, data
        self.absent: tuple[HiddenObject, ...] = ()  # objects that are parked

    def describe(self, name: str, region: str) -> HiddenObject:
        """Return an object that rests in a drawer, with its present pose relative to the drawer."""
        body, site = self._data.body(name), self._data.site(region)
        return HiddenObject(name, region, body.xpos - site.xpos, body.xquat.copy())

    def park(self) -> None:
        """Write the poses of absent objects; the derived quantities of ``data`` are not updated."""
        for hidden in self.absent:
            height = PARKING_HEIGHT + self._model.body(hidden.name).id
            self._write(hidden.name, np.array([0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]), np.zeros(3))

    def reveal(self, regions: Sequence[str]) -> list[str]:
        """Put absent objects into the drawers of ``regions``, with the drawers' velocities; return their names."""
        revealed = [hidden for hidden in self.absent if hidden.region in regions]
        self.absent = tuple(hidden for hidden in self.absent if hidden not in revealed)
        for hidden in revealed:
            velocity = np.empty(6)  # angular part first
            site = self._data.site(hidden.region)
            mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_SITE, site.id, velocity, 0)
            self._write(hidden.name, np.concatenate([site.xpos + hidden.offset, hidden.quaternion]), velocity[3:])
        return [hidden.name for hidden in revealed]

    def _write(self, name: str, pose: Array, velocity: Array) -> None:
        joint = self._model.joint(int(self._model.body(name).jntadr[0]))
        qpos, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
        self._data.qpos[qpos : qpos + 7] = pose
        self._data.qvel[dof : dof + 6] = [*velocity, 0.0, 0.0, 0.0]
