"""Domain randomisation of a scene without stepping its physics: distractors, objects put elsewhere, the arm above one.

A task has few objects, and most classes are in one or two tasks: distractors of all other classes wait where no camera
looks. Poses are free: objects lie on their sides, float in the hand, are in open drawers and on one another, and
doors and drawers are half open. Objects that still overlap are taken out of sight.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.expert import highlight_of
from lerobot_memobench.experts.hand import downward
from lerobot_memobench.sim.asset import TABLE, TABLE_TOP, Asset, Grasp
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.robot import ARM_JOINTS, FINGER_JOINTS, GRIP_SITE
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task
from mujoco_raster.highlights import Highlight

Array = NDArray[np.float64]

DROP_HEIGHT, MAX_CONTACT_DEPTH = 0.0005, 0.0015
"""Initial height of an object above its support, and largest contact depth of objects at rest, m."""
DISTRACTOR = "more_"
"""Prefix of the names of distractors."""
AREA = ((-0.30, 0.25), (-0.38, 0.38))
"""Where on the table objects are put, x and y, m."""
MOVED, LYING, SUPPORTED, HELD, ABSENT = 0.7, 0.1, 0.25, 0.3, 0.05
"""Probabilities: of an object to be moved, and then to lie in any way, to be put on or into another, to be taken away;
and of one of them to be held."""
MARKED = 0.3
"""Probability of an image to show a highlight."""
NEAR = 0.15
"""Distance of the hand from an object at which a reach counts as nearly there, m."""
SLIDE, TURN = 0.03, 0.1
"""How far a fixture is moved at most along x and y, m, and turned, rad."""
ROUNDS = 6
"""How often overlapping objects are put elsewhere before they are taken away."""
ARM = "robot0_base"
"""Root of the arm's tree of bodies."""
AWAY = (30.0, 0.0, 5.0)
"""Where objects are taken away to, m: no camera looks there, and no shadow of theirs falls on the table."""
ITERATIONS, STRIDE, DAMPING = 40, 0.25, 0.02
"""Of `reach`: iterations, largest change of a joint in one, rad, and the damping of its least squares."""
REACHED = 0.005
"""Tolerance of `reach`, m and rad."""


class DomainRandomisation:
    """Randomise the present state of one simulation; `Simulation.set_state` undoes all but the fixtures' poses.

    Args:
        sim: the running scene. rng: source of every choice.
    """

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self._sim, self._rng = sim, rng
        self._objects = {name: asset for name, asset in sim.assets.items() if asset.kind == "object"}
        self._parts = [part for asset in sim.assets.values() for part in asset.articulations.values()]

    def apply(self, *, reach: bool) -> bool:
        """Put objects elsewhere, and with ``reach`` the arm near one of them; return whether the arm is free."""
        self._move_fixtures()
        share = self._rng.random()  # of the distractors: images with few objects and with many
        chances = {name: share if name.startswith(DISTRACTOR) else MOVED for name in self._objects}
        moved = [name for name, chance in chances.items() if self._rng.random() < chance]
        held = str(self._rng.choice(list(self._objects))) if self._objects and self._rng.random() < HELD else None
        for name in moved:
            self._put(name)
        for _ in range(ROUNDS):
            settle(self._sim)
            wrong = self._overlapping() & set(moved)
            if not wrong:
                break
            for name in sorted(wrong):
                self._put(name)
        if reach and not self._reach():
            return False
        if held is not None:
            self._hold(held)
        settle(self._sim)
        for name in self._overlapping(held) & set(self._objects):
            self._take_away(name)
        settle(self._sim)
        return not self._overlapping(held)

    def highlights(self) -> tuple[Highlight, ...]:
        """Return the highlight of one of the objects, or none."""
        if not self._objects or self._rng.random() >= MARKED:
            return ()
        return (highlight_of(self._sim, str(self._rng.choice(list(self._objects)))),)

    def _move_fixtures(self) -> None:
        model, rng = self._sim.model, self._rng
        for name in self._sim.fixture_poses():
            body = model.body(name).id
            turn = Rotation.from_quat(model.body_quat[body], scalar_first=True)
            turn = Rotation.from_rotvec([0, 0, rng.uniform(-TURN, TURN)]) * turn
            slide = np.append(rng.uniform(-SLIDE, SLIDE, 2), 0.0)
            moved = pose(model.body_pos[body] + slide, turn)
            model.body_pos[body], model.body_quat[body] = moved[:3], moved[3:]
        for part in self._parts:
            share = rng.uniform() if rng.random() < 0.5 else round(rng.uniform())
            self._sim.data.joint(part.joint).qpos[0] = part.closed_q + share * (part.open_q - part.closed_q)
        settle(self._sim)

    def _put(self, name: str) -> None:
        rng, asset = self._rng, self._objects[name]
        if rng.random() < ABSENT:
            self._take_away(name)
            return
        lying = rng.random() < LYING
        turn = Rotation.random(random_state=rng) if lying else Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
        others = [
            other
            for other in self._sim.assets.values()
            if other.name != name and (other.regions or other.clear_radius > 0)
        ]
        if others and rng.random() < SUPPORTED:
            x, y, z = self._on(asset, others[int(rng.integers(len(others)))])
        else:
            x, y, z = (*(float(rng.uniform(*side)) for side in AREA), TABLE_TOP)
        self._write(name, standing(asset, x, y, z, turn))

    def _on(self, asset: Asset, other: Asset) -> tuple[float, float, float]:
        rng, sim = self._rng, self._sim
        if not other.regions:
            x, y, z = sim.body_pose(other.name)[0] + [*(rng.normal(size=2) * other.clear_radius / 4), other.supports]
            return float(x), float(y), float(z)
        site = other.regions[str(rng.choice(list(other.regions)))]
        middle, rotation = sim.site_pose(site)
        half = np.abs(rotation @ sim.site_half_size(site))
        room = np.maximum(half[:2] - asset.radius, 0.0)
        flat = half[2] if site.endswith(("_side", "cook_region")) else -half[2]
        x, y, z = middle + np.array([*rng.uniform(-room, room), flat])
        return float(x), float(y), float(z)

    def _reach(self) -> bool:
        rng, sim = self._rng, self._sim
        goals = [(*sim.asset_pose(name), asset.grasps[0]) for name, asset in self._objects.items() if asset.grasps]
        places = [(place + turned @ np.array(grasp.position), grasp.yaw) for place, turned, grasp in goals]
        places = [(place, yaw) for place, yaw in places if place[0] < AWAY[0] / 2]
        places += [(sim.site_pose(part.handle_site)[0], 0.0) for part in self._parts]
        if not places:
            return False
        place, yaw = places[int(rng.integers(len(places)))]
        height = NEAR * rng.random() ** 1.5
        place = place + np.array([*(rng.normal(size=2) * (0.004 + 0.2 * height)), height + 0.005])
        tilt = Rotation.from_rotvec(rng.normal(size=3) * [0.06, 0.06, 0.15])
        self._open(rng.uniform(0.015, 0.04))
        return reach(sim, place, tilt.as_matrix() @ downward(yaw + rng.choice([0.0, np.pi])))

    def _hold(self, name: str) -> None:
        grasps, rng = self._objects[name].grasps, self._rng
        if not grasps:
            return
        settle(self._sim)
        grasp = grasps[int(rng.integers(len(grasps)))]
        position, rotation = self._sim.eef_pose()
        slip = rotation @ np.array([0.0, *(rng.normal(size=2) * 0.004)])
        self._write(name, held(grasp, position + slip, rotation))
        self._open(min(grasp.width / 2, 0.04))

    def _open(self, half: float) -> None:
        for joint, sign in zip(FINGER_JOINTS, (1.0, -1.0), strict=True):
            self._sim.data.joint(joint).qpos[0] = sign * half

    def _take_away(self, name: str) -> None:
        self._write(name, away(list(self._objects).index(name)))

    def _write(self, name: str, upright: Array) -> None:
        frame = self._objects[name].upright
        if frame is not None:
            turn = Rotation.from_quat(upright[3:], scalar_first=True)
            upright = pose(upright[:3], turn * Rotation.from_quat(frame, scalar_first=True).inv())
        self._sim.data.joint(f"{name}_joint0").qpos[:] = upright

    def _overlapping(self, held: str | None = None) -> set[str]:
        """Return the names of bodies, at the roots of their trees, that penetrate one another; a held one may."""
        model, data = self._sim.model, self._sim.data
        contact = data.contact
        deep = contact.geom[contact.dist < -MAX_CONTACT_DEPTH] if data.ncon else np.zeros((0, 2), np.int64)
        roots = model.body_rootid[model.geom_bodyid]
        pairs = [{str(model.body(roots[geom]).name) for geom in pair} for pair in deep]
        return {name for pair in pairs if pair != {held, ARM} for name in pair} - {"world", held}


@cache
def object_classes() -> tuple[str, ...]:
    """Return the classes, including variants, of all objects of the catalogue."""
    return tuple(sorted({one for name in task_names(suite=None) for one in get_task(name).objects.values()}))


def with_distractors(sim: Simulation, rng: np.random.Generator) -> Simulation:
    """Return a scene like that of ``sim`` with distractors of different classes, as many as can be labelled."""
    room = SLOTS - len(ObjectSlots(sim).things)
    chosen = rng.choice(object_classes(), min(room, len(object_classes())), replace=False)
    return Simulation(_task_with(sim.task, [str(one) for one in chosen]), sim.render_settings)


def _task_with(task: Task, classes: list[str]) -> Task:
    more = {f"{DISTRACTOR}{index}": name for index, name in enumerate(classes)}
    somewhere = next(name for name, region in task.regions.items() if region.target == TABLE)
    return replace(
        task,
        objects={**task.objects, **more},
        init=(*task.init, *(Atom("on", (name, somewhere)) for name in more)),
        bddl_text=f"{task.bddl_text}\n; and {', '.join(classes)}",  # compiled scenes are known by their text
    )


def widened(state: Array, sim: Simulation, crowd: Simulation) -> Array:
    """Return a state of ``sim`` as one of its `with_distractors`: those are away, at rest."""
    made = np.concatenate([state[:1], crowd.model.qpos0, np.zeros(crowd.model.nv)])
    for index in range(sim.model.njnt):
        mine, theirs = sim.model.joint(index), crowd.model.joint(sim.model.joint(index).name)
        count = len(mine.qpos0)
        made[1 + theirs.qposadr[0] :][:count] = state[1 + mine.qposadr[0] :][:count]
        count = 6 if count == 7 else 1
        made[1 + crowd.model.nq + theirs.dofadr[0] :][:count] = state[1 + sim.model.nq + mine.dofadr[0] :][:count]
    for index, name in enumerate(name for name in crowd.assets if name.startswith(DISTRACTOR)):
        address = 1 + int(crowd.model.joint(f"{name}_joint0").qposadr[0])
        made[address : address + 7] = away(index)
    return made


def pose(position: Array, turn: Rotation) -> Array:
    """Return position and quaternion wxyz as one vector (7,)."""
    return np.concatenate([position, turn.as_quat(scalar_first=True)])


def away(index: int) -> Array:
    """Return a pose (7,) of its own for each object that is taken away."""
    return pose(np.add(AWAY, [0.0, index, 0.0]), Rotation.identity())


def standing(asset: Asset, x: float, y: float, z: float, turn: Rotation) -> Array:
    """Return the pose (7,) of an object with a rotation whose lowest corner is at a height z, m."""
    corners = np.array(list(itertools.product(*zip(asset.low, asset.high, strict=True))))
    return pose(np.array([x, y, z + DROP_HEIGHT - turn.apply(corners)[:, 2].min()]), turn)


def held(grasp: Grasp, position: Array, rotation: Array) -> Array:
    """Return the pose (7,) of an object that a hand at a pose holds by a grasp."""
    closing = np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    body = np.array([closing, np.cross(up, closing), up])
    turn = np.array([rotation[:, 0], -rotation[:, 1], -rotation[:, 2]]).T @ body
    return pose(position - turn @ np.array(grasp.position), Rotation.from_matrix(turn))


def reach(sim: Simulation, position: Array, rotation: Array) -> bool:
    """Bend the arm until the hand is at a pose, by damped least squares; return whether it got there.

    Only qpos is written, and kinematics.
    """
    model, data, site = sim.model, sim.data, sim.model.site(GRIP_SITE).id
    joints = [model.joint(name) for name in ARM_JOINTS]
    addresses, columns = [int(j.qposadr[0]) for j in joints], [int(j.dofadr[0]) for j in joints]
    low, high = np.array([joint.range for joint in joints]).T
    jacobian = np.zeros((6, model.nv))
    for _ in range(ITERATIONS):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        here, turned = sim.eef_pose()
        missing = np.concatenate([position - here, Rotation.from_matrix(rotation @ turned.T).as_rotvec()])
        if np.abs(missing).max() < REACHED:
            return True
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        by = jacobian[:, columns]
        step = by.T @ np.linalg.solve(by @ by.T + DAMPING**2 * np.eye(6), missing)
        step *= min(1.0, STRIDE / np.abs(step).max())
        data.qpos[addresses] = np.clip(data.qpos[addresses] + step, low, high)
    return False


def settle(sim: Simulation) -> None:
    """Bring all that depends on poses up to date after they were written."""
    mujoco.mj_fwdPosition(sim.model, sim.data)
