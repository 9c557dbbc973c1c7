"""Domain randomisation: no penetration, held objects, distractors out of sight, and a restored state."""

from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.experts.hand import downward
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector import randomisation
from research.detector.labels import Labeller
from research.detector.randomisation import (
    DISTRACTOR,
    MAX_CONTACT_DEPTH,
    DomainRandomisation,
    held,
    object_classes,
    reach,
    widened,
    with_distractors,
)
from tests.support.labelled_images import BOWLS, DRAWERS, simulation


def test_the_moment_comes_back() -> None:
    sim = simulation(DRAWERS)
    state, fixed, scene = sim.state(), sim.fixture_poses(), sim.scene_hash()
    randomise = DomainRandomisation(sim, np.random.default_rng(0))
    randomise.apply(reach=True)
    assert sim.scene_hash() != scene
    sim.set_state(state, fixed)
    assert sim.scene_hash() == scene


def test_nothing_stands_in_anything() -> None:
    sim = simulation(BOWLS)
    state, fixed = sim.state(), sim.fixture_poses()
    randomise = DomainRandomisation(sim, np.random.default_rng(1))
    objects = [name for name, asset in sim.assets.items() if asset.kind == "object"]
    places, free = [], 0
    for _ in range(30):
        sim.set_state(state, fixed)
        if not randomise.apply(reach=True):
            continue
        free += 1
        places.append([sim.body_pose(name)[0] for name in objects])
        for pair in sim.data.contact.geom[sim.data.contact.dist < -MAX_CONTACT_DEPTH]:
            roots = {sim.model.body(sim.model.body_rootid[sim.model.geom_bodyid[geom]]).name for geom in pair}
            assert roots - set(objects) == {"robot0_base"}  # the fingers touch the held object alone
    assert free > 10
    seen = np.array(places).reshape(-1, 3)
    assert (np.std(seen[seen[:, 2] < 2], axis=0)[:2] > 0.05).all()


def test_an_empty_table_has_nothing_to_reach_for(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MOVED", "ABSENT"):
        monkeypatch.setattr(randomisation, name, 1.0)
    assert not DomainRandomisation(simulation(BOWLS), np.random.default_rng(0)).apply(reach=True)


def test_the_arm_reaches_a_pose() -> None:
    sim = simulation(BOWLS)
    place = sim.body_pose("butter_1")[0] + [0.02, 0.0, 0.1]
    assert reach(sim, place, downward(0.4))
    position, rotation = sim.eef_pose()
    assert np.abs(position - place).max() < 0.006
    assert np.abs(rotation - downward(0.4)).max() < 0.01
    assert not reach(sim, np.array([2.0, 0.0, 1.0]), downward(0.0))


def test_a_held_thing_is_between_the_fingers() -> None:
    sim = simulation(BOWLS)
    grasp = sim.assets["butter_1"].grasps[0]
    position, rotation = sim.eef_pose()
    sim.data.joint("butter_1_joint0").qpos[:] = held(grasp, position, rotation)
    sim.set_state(sim.state())
    place, turned = sim.body_pose("butter_1")
    assert np.allclose(place + turned @ np.array(grasp.position), position, atol=1e-6)
    closing = turned @ np.array([np.cos(grasp.yaw), np.sin(grasp.yaw), 0.0])
    assert np.allclose(closing, rotation[:, 0], atol=1e-6)
    assert np.allclose(turned[:, 2], -rotation[:, 2], atol=1e-6)


def test_a_moment_looks_the_same_until_things_are_put() -> None:
    sim = simulation(DRAWERS)
    sim.step(np.full(7, 0.5))
    crowd = with_distractors(sim, np.random.default_rng(0))
    assert len(ObjectSlots(crowd).things) == SLOTS
    crowd.set_state(widened(sim.state(), sim, crowd), sim.fixture_poses())
    for name in sim.assets:
        for mine, theirs in zip(sim.body_pose(name), crowd.body_pose(name), strict=True):
            assert np.allclose(mine, theirs)
    added = [name for name in crowd.assets if name.startswith(DISTRACTOR)]
    places = np.array([crowd.body_pose(name)[0] for name in added])
    assert (places[:, 0] > 10).all()
    assert len(np.unique(places, axis=0)) == len(added)
    for camera in MJCF_CAMERAS:
        far = np.abs(sim.render(camera).astype(int) - crowd.render(camera)).max(axis=-1)
        assert (far > 8).mean() < 0.002  # floats of other models differ in a last bit, and pixels of edges with it


def test_all_classes_come_alike() -> None:
    sim, rng = simulation(DRAWERS), np.random.default_rng(0)
    own = {asset.class_name for asset in sim.assets.values()}
    chosen = [
        {asset.class_name for name, asset in with_distractors(sim, rng).assets.items() if name.startswith(DISTRACTOR)}
        for _ in range(12)
    ]
    assert all(len(one) == SLOTS - len(ObjectSlots(sim).things) for one in chosen), "each class at most once"
    assert len(set.union(*chosen) | own) > 0.9 * len(object_classes())


def test_some_are_seen_when_they_are_put() -> None:
    sim, rng = simulation(DRAWERS), np.random.default_rng(0)
    crowd = with_distractors(sim, rng)
    randomise, labeller, seen = DomainRandomisation(crowd, rng), Labeller(crowd), []
    for _ in range(20):
        crowd.set_state(widened(sim.state(), sim, crowd), sim.fixture_poses())
        if randomise.apply(reach=True):
            seen.append(labeller.take("agentview")["count"])
    assert len(seen) > 6, "the arm reaches for visible objects, not for distractors out of sight"
    assert max(seen) >= 9
    assert min(seen) < 7
