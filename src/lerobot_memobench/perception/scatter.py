"""Things put elsewhere in the same moment, and the arm above one of them: variety that costs no physics.

What is left overlapping is taken out of sight. Poses are free: things lie on their sides, float in the hand, stand in
open drawers and on one another, and doors and drawers are half open.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lerobot_memobench.experts.demonstration_prompt import highlight_of
from lerobot_memobench.experts.hand import downward
from lerobot_memobench.perception import poses
from lerobot_memobench.perception.crowd import MORE
from lerobot_memobench.perception.labels import settle
from lerobot_memobench.perception.walk import NEAR
from lerobot_memobench.sim.assets.asset import Asset
from lerobot_memobench.sim.placement import PENETRATION
from lerobot_memobench.sim.rendering import Highlight
from lerobot_memobench.sim.robot import FINGER_JOINTS
from lerobot_memobench.sim.scene import TABLE_TOP
from lerobot_memobench.sim.simulation import Simulation

Array = NDArray[np.float64]

AREA = ((-0.30, 0.25), (-0.38, 0.38))
"""Where on the table things are put, x and y, m."""
MOVED, LYING, SUPPORTED, HELD, ABSENT = 0.7, 0.1, 0.25, 0.3, 0.05
"""Chances: of a thing to be moved, and then to lie in any way, to be put on or into another, to be taken away; and of
one of them to be held."""
MARKED = 0.3
"""Chance of a picture to show a highlight."""
SLIDE, TURN = 0.03, 0.1
"""How far a fixture is moved at most along x and y, m, and turned, rad."""
ROUNDS = 6
"""How often what overlaps is put elsewhere before it is taken away."""
ARM = "robot0_base"
"""Root of the arm's tree of bodies."""


class Scatter:
    """Change the present moment of one simulation; `Simulation.set_state` undoes all but the fixtures' poses.

    Args:
        sim: the running scene. rng: source of every choice.
    """

    def __init__(self, sim: Simulation, rng: np.random.Generator) -> None:
        self._sim, self._rng = sim, rng
        self._objects = {name: asset for name, asset in sim.assets.items() if asset.kind == "object"}
        self._parts = [part for asset in sim.assets.values() for part in asset.articulations.values()]

    def stir(self, *, reach: bool) -> bool:
        """Put things elsewhere, and with ``reach`` the arm near one of them; return whether the arm is free."""
        self._move_fixtures()
        share = self._rng.random()  # of a crowd: pictures with few things and with many
        chances = {name: share if name.startswith(MORE) else MOVED for name in self._objects}
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

    def marks(self) -> tuple[Highlight, ...]:
        """Return the highlight of one of the things, or none."""
        if not self._objects or self._rng.random() >= MARKED:
            return ()
        return (highlight_of(self._sim, str(self._rng.choice(list(self._objects)))),)

    def _move_fixtures(self) -> None:
        """Fixtures a little, their moving parts anywhere between their ends, half of them to one of those."""
        model, rng = self._sim.model, self._rng
        for name in self._sim.fixture_poses():
            body = model.body(name).id
            turn = Rotation.from_quat(model.body_quat[body], scalar_first=True)
            turn = Rotation.from_rotvec([0, 0, rng.uniform(-TURN, TURN)]) * turn
            slide = np.append(rng.uniform(-SLIDE, SLIDE, 2), 0.0)
            moved = poses.pose(model.body_pos[body] + slide, turn)
            model.body_pos[body], model.body_quat[body] = moved[:3], moved[3:]
        for part in self._parts:
            share = rng.uniform() if rng.random() < 0.5 else round(rng.uniform())
            self._sim.data.joint(part.joint).qpos[0] = part.closed_q + share * (part.open_q - part.closed_q)
        settle(self._sim)

    def _put(self, name: str) -> None:
        """Put an object on the table, on or into something, or away."""
        rng, asset = self._rng, self._objects[name]
        if rng.random() < ABSENT:
            self._take_away(name)
            return
        lying = rng.random() < LYING
        turn = Rotation.random(random_state=rng) if lying else Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])
        others = [other for other in self._sim.assets.values() if other.name != name and _room(other)]
        if others and rng.random() < SUPPORTED:
            x, y, z = self._on(asset, others[int(rng.integers(len(others)))])
        else:
            x, y, z = (*(float(rng.uniform(*side)) for side in AREA), TABLE_TOP)
        self._write(name, poses.standing(asset, x, y, z, turn))

    def _on(self, asset: Asset, other: Asset) -> tuple[float, float, float]:
        """Return a place on another object, or in one of a fixture's regions, on its floor or on its top."""
        rng, sim = self._rng, self._sim
        if not other.regions:
            x, y, z = sim.body_pose(other.name)[0] + [*(rng.normal(size=2) * other.clear_radius / 4), other.supports]
            return float(x), float(y), float(z)
        site = other.regions[str(rng.choice(list(other.regions)))]
        (middle, rotation), half = sim.site_pose(site), sim.site_half_size(site)
        room = np.maximum(half[:2] - asset.radius, 0.0)
        flat = half[2] if site.endswith(("_side", "cook_region")) else -half[2]
        x, y, z = middle + rotation @ np.array([*rng.uniform(-room, room), flat])
        return float(x), float(y), float(z)

    def _reach(self) -> bool:
        """Bend the arm to a pose above an object or a handle, the nearer the likelier."""
        rng, sim = self._rng, self._sim
        goals = [(*sim.body_pose(name), asset.grasps[0]) for name, asset in self._objects.items() if asset.grasps]
        places = [(place + turned @ np.array(grasp.position), grasp.yaw) for place, turned, grasp in goals]
        places = [(place, yaw) for place, yaw in places if place[0] < poses.AWAY[0] / 2]
        places += [(sim.site_pose(part.handle_site)[0], 0.0) for part in self._parts]
        if not places:
            return False
        place, yaw = places[int(rng.integers(len(places)))]
        height = NEAR * rng.random() ** 1.5
        place = place + np.array([*(rng.normal(size=2) * (0.004 + 0.2 * height)), height + 0.005])
        tilt = Rotation.from_rotvec(rng.normal(size=3) * [0.06, 0.06, 0.15])
        opening = rng.uniform(0.015, 0.04)
        self._open(opening)
        return poses.reach(sim, place, tilt.as_matrix() @ downward(yaw + rng.choice([0.0, np.pi])))

    def _hold(self, name: str) -> None:
        """Put an object between the fingers."""
        grasps, rng = self._objects[name].grasps, self._rng
        if not grasps:
            return
        settle(self._sim)
        grasp = grasps[int(rng.integers(len(grasps)))]
        position, rotation = self._sim.eef_pose()
        slip = rotation @ np.array([0.0, *(rng.normal(size=2) * 0.004)])
        self._write(name, poses.held(grasp, position + slip, rotation))
        self._open(min(grasp.width / 2, 0.04))

    def _open(self, half: float) -> None:
        for joint, sign in zip(FINGER_JOINTS, (1.0, -1.0), strict=True):
            self._sim.data.joint(joint).qpos[0] = sign * half

    def _take_away(self, name: str) -> None:
        """Put an object where no camera looks, each at a place of its own."""
        self._write(name, poses.away(list(self._objects).index(name)))

    def _write(self, name: str, pose: Array) -> None:
        self._sim.data.joint(f"{name}_joint0").qpos[:] = pose

    def _overlapping(self, held: str | None = None) -> set[str]:
        """Return the names of bodies, at the roots of their trees, that stand in one another; a held one may."""
        model, data = self._sim.model, self._sim.data
        contact = data.contact
        deep = contact.geom[contact.dist < -PENETRATION] if data.ncon else np.zeros((0, 2), np.int64)
        pairs = [{self._root(int(model.geom_bodyid[geom])) for geom in pair} for pair in deep]
        return {name for pair in pairs if pair != {held, ARM} for name in pair} - {"world", held}

    def _root(self, body: int) -> str:
        """The name of the root of a body's tree: an instance, or the arm."""
        model = self._sim.model
        return str(model.body(model.body_rootid[body]).name)


def _room(asset: Asset) -> bool:
    return bool(asset.regions) or asset.clear_radius > 0
