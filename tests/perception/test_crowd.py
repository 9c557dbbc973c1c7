"""More things in a scene: the task's own are where they were, the added ones out of sight until they are put."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lerobot_memobench.perception.crowd import MORE, crowded, object_classes, widened
from lerobot_memobench.perception.labels import Labeller
from lerobot_memobench.perception.scatter import Scatter
from lerobot_memobench.sim.object_layout import SLOTS
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation

from .conftest import DRAWERS

Simulate = Callable[[str], Simulation]


def test_a_moment_looks_the_same_until_things_are_put(gl: str, simulate: Simulate) -> None:
    sim = simulate(DRAWERS)
    sim.step(np.full(7, 0.5))
    crowd = crowded(sim, np.random.default_rng(0))
    assert len(ObjectSlots(crowd).things) == SLOTS
    crowd.set_state(widened(sim.state(), sim, crowd), sim.fixture_poses())
    for name in sim.assets:
        for mine, theirs in zip(sim.body_pose(name), crowd.body_pose(name), strict=True):
            assert np.allclose(mine, theirs)
    added = [name for name in crowd.assets if name.startswith(MORE)]
    places = np.array([crowd.body_pose(name)[0] for name in added])
    assert (places[:, 0] > 10).all()
    assert len(np.unique(places, axis=0)) == len(added)
    for camera in MJCF_CAMERAS:
        far = np.abs(sim.render(camera).astype(int) - crowd.render(camera)).max(axis=-1)
        assert (far > 8).mean() < 0.002  # floats of other models differ in a last bit, and pixels of edges with it


def test_all_classes_come_alike(gl: str, simulate: Simulate) -> None:
    sim, rng = simulate(DRAWERS), np.random.default_rng(0)
    own = {asset.class_name for asset in sim.assets.values()}
    chosen = [
        {asset.class_name for name, asset in crowded(sim, rng).assets.items() if name.startswith(MORE)}
        for _ in range(12)
    ]
    assert all(len(one) == SLOTS - len(ObjectSlots(sim).things) for one in chosen), "each class at most once"
    assert len(set.union(*chosen) | own) > 0.9 * len(object_classes())


def test_some_are_seen_when_they_are_put(gl: str, simulate: Simulate) -> None:
    sim, rng = simulate(DRAWERS), np.random.default_rng(0)
    crowd = crowded(sim, rng)
    scatter, labeller, seen = Scatter(crowd, rng), Labeller(crowd), []
    for _ in range(20):
        crowd.set_state(widened(sim.state(), sim, crowd), sim.fixture_poses())
        if scatter.stir(reach=True):
            seen.append(labeller.look("agentview")["count"])
    assert len(seen) > 6, "the arm reaches for what is there, not for what waits"
    assert max(seen) >= 9
    assert min(seen) < 7
