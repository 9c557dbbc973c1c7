"""Things put elsewhere: nothing stands in anything, things are in the hand, and the moment comes back."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from lerobot_memobench.experts.hand import downward
from lerobot_memobench.perception import scatter as scatter_module
from lerobot_memobench.perception.poses import held, reach
from lerobot_memobench.perception.scatter import Scatter
from lerobot_memobench.sim.placement import PENETRATION
from lerobot_memobench.sim.simulation import Simulation

from .conftest import BOWLS, DRAWERS

Simulate = Callable[[str], Simulation]


def test_the_moment_comes_back(simulate: Simulate) -> None:
    sim = simulate(DRAWERS)
    state, fixed, scene = sim.state(), sim.fixture_poses(), sim.scene_hash()
    scatter = Scatter(sim, np.random.default_rng(0))
    scatter.stir(reach=True)
    assert sim.scene_hash() != scene
    sim.set_state(state, fixed)
    assert sim.scene_hash() == scene


def test_nothing_stands_in_anything(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    state, fixed = sim.state(), sim.fixture_poses()
    scatter = Scatter(sim, np.random.default_rng(1))
    objects = [name for name, asset in sim.assets.items() if asset.kind == "object"]
    places, free = [], 0
    for _ in range(30):
        sim.set_state(state, fixed)
        if not scatter.stir(reach=True):
            continue
        free += 1
        places.append([sim.body_pose(name)[0] for name in objects])
        for pair in sim.data.contact.geom[sim.data.contact.dist < -PENETRATION]:
            roots = {sim.model.body(sim.model.body_rootid[sim.model.geom_bodyid[geom]]).name for geom in pair}
            assert roots - set(objects) == {"robot0_base"}  # only what is held is touched, by the fingers
    assert free > 10
    seen = np.array(places).reshape(-1, 3)
    assert (np.std(seen[seen[:, 2] < 2], axis=0)[:2] > 0.05).all()


def test_an_empty_table_has_nothing_to_reach_for(simulate: Simulate, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MOVED", "ABSENT"):
        monkeypatch.setattr(scatter_module, name, 1.0)
    assert not Scatter(simulate(BOWLS), np.random.default_rng(0)).stir(reach=True)


def test_the_arm_reaches_a_pose(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    place = sim.body_pose("butter_1")[0] + [0.02, 0.0, 0.1]
    assert reach(sim, place, downward(0.4))
    position, rotation = sim.eef_pose()
    assert np.abs(position - place).max() < 0.006
    assert np.abs(rotation - downward(0.4)).max() < 0.01
    assert not reach(sim, np.array([2.0, 0.0, 1.0]), downward(0.0))


def test_a_held_thing_is_between_the_fingers(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    grasp = sim.assets["butter_1"].grasps[0]
    position, rotation = sim.eef_pose()
    sim.data.joint("butter_1_joint0").qpos[:] = held(grasp, position, rotation)
    sim.set_state(sim.state())
    place, turned = sim.body_pose("butter_1")
    assert np.allclose(place + turned @ np.array(grasp.position), position, atol=1e-6)
    closing = turned @ np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    assert np.allclose(closing, rotation[:, 0], atol=1e-6)
    assert np.allclose(turned[:, 2], -rotation[:, 2], atol=1e-6)
