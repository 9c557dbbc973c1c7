"""Object observations contain visible things without identity, and need no rendering."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from lerobot_memobench.envs.episode import Episode
from lerobot_memobench.sim.object_layout import SLOTS, STARTS, WIDTH, field
from lerobot_memobench.sim.object_slots import POSE_RESOLUTION, ObjectSlots, classes
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task, task_names
from mujoco_raster.highlights import Highlight

NINE = "put_the_butter_picked_up_in_the_prompt_video_on_the_plate"
DRAWERS = "put_the_tomato_into_the_top_drawer_of_the_cabinet"
TOMATO, TOP = "beefsteak_tomato__1_1", "wooden_cabinet_1_top_region"

ROUNDED = POSE_RESOLUTION / 2 + 1e-6
"""Largest rounding error of a pose."""


def started(name: str, seed: int = 20_000) -> Simulation:
    sim = Simulation(get_task(name))
    sim.reset(seed)
    return sim


def table(sim: Simulation, slots: ObjectSlots | None = None) -> NDArray[np.float32]:
    """Return the filled slots (n, WIDTH)."""
    found = (slots or ObjectSlots(sim)).observe().reshape(SLOTS, WIDTH)
    count = int(found[:, 0].sum())
    assert not found[count:].any()
    return found[:count]


def names(rows: NDArray[np.float32]) -> list[str]:
    return [classes()[int(kind)] for kind in rows[:, STARTS["class"]]]


def put(sim: Simulation, name: str, position: NDArray[np.float64]) -> None:
    """Set a free body down somewhere, as it stood."""
    address = int(sim.model.joint(f"{name}_joint0").qposadr[0])
    sim.data.qpos[address : address + 3] = position
    mujoco.mj_forward(sim.model, sim.data)


def pull(sim: Simulation, region: str, q: float) -> None:
    articulation, _ = sim.world.articulation(region)
    sim.data.qpos[int(sim.model.joint(articulation.joint).qposadr[0])] = q
    mujoco.mj_forward(sim.model, sim.data)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in task_names()[::6] else pytest.mark.slow) for name in task_names()]
)
def test_every_scene_fits_with_correct_poses(name: str) -> None:
    sim = started(name)
    rows = table(sim)
    kinds = names(rows)
    assert sorted(kinds, key=classes().index) == kinds
    places = field(rows, "position")
    for place, kind in zip(places, kinds, strict=True):
        bodies = [asset for asset in sim.assets.values() if asset.class_name.startswith(kind)]
        if bodies:
            nearest = min(np.abs(sim.body_pose(asset.name)[0] - place).max() for asset in bodies)
            assert nearest < ROUNDED
    np.testing.assert_allclose(
        np.linalg.norm(field(rows, "rotation").reshape(-1, 2, 3), axis=2), 1.0, atol=POSE_RESOLUTION
    )
    assert not field(rows, "highlighted").any()


def seen_pixels(sim: Simulation, name: str) -> int:
    """Return the pixels of both cameras that change without the object; there are no shadows."""
    images, state = [], sim.state()
    for _ in range(2):
        images.append(np.stack([sim.render(camera) for camera in MJCF_CAMERAS]))
        put(sim, name, np.array([0.0, 0.0, -5.0]))
    sim.set_state(state)
    return int((images[0] != images[1]).any(axis=-1).sum())


@pytest.mark.parametrize("name", [pytest.param(NINE, marks=pytest.mark.slow), DRAWERS])
def test_visibility_agrees_with_pixels(name: str) -> None:
    episode = Episode(get_task(name), demonstration_prompt=False, render=RenderSettings(256, 256))
    episode.reset(20_001)
    sim, other = episode.sim, Simulation(get_task(name), RenderSettings(256, 256))
    slots = ObjectSlots(sim)
    for step in range(320):
        episode.step(episode.expert_action())
        if step % 40:
            continue
        places = field(table(sim, slots), "position")
        other.set_state(sim.state(), sim.fixture_poses())
        for asset in (asset.name for asset in sim.assets.values() if asset.kind == "object"):
            there = np.abs(places - sim.body_pose(asset)[0]).max(axis=1).min() < ROUNDED
            count = seen_pixels(other, asset)
            assert there or count < 120, (step, asset, count)
            assert not there or count > 0, (step, asset)


def test_hidden_things_are_absent() -> None:
    sim = started(DRAWERS)
    slots = ObjectSlots(sim)
    kind = sim.assets[TOMATO].class_name.partition("__")[0]
    assert kind in names(table(sim, slots))
    articulation, _ = sim.world.articulation(TOP)
    put(sim, TOMATO, sim.site_pose(TOP)[0])
    assert kind not in names(table(sim, slots))
    pull(sim, TOP, articulation.open_q)
    put(sim, TOMATO, sim.site_pose(TOP)[0])
    rows = table(sim, slots)
    assert kind in names(rows)
    drawn = field(rows[[k for k, name in enumerate(names(rows)) if name == "drawer"]], "joint")
    assert np.abs(drawn - articulation.open_q).min() < ROUNDED
    put(sim, TOMATO, np.array([-0.6, 0.0, 0.3]))  # below the table
    assert kind not in names(table(sim, slots))


def test_exchanging_equal_objects_changes_nothing() -> None:
    sim = started(NINE)
    slots = ObjectSlots(sim)
    before = slots.observe()
    one, other = [name for name, asset in sim.assets.items() if asset.class_name == "butter"][:2]
    addresses = [int(sim.model.joint(f"{name}_joint0").qposadr[0]) for name in (one, other)]
    poses = [sim.data.qpos[address : address + 7].copy() for address in addresses]
    for address, pose in zip(addresses, reversed(poses), strict=True):
        sim.data.qpos[address : address + 7] = pose
    mujoco.mj_forward(sim.model, sim.data)
    np.testing.assert_array_equal(slots.observe(), before)
    assert sim.body_pose(one)[0] @ sim.body_pose(one)[0] != pytest.approx(poses[0][:3] @ poses[0][:3])


def test_observations_depend_on_the_present_state_only() -> None:
    """Neither history nor goal matter: a variant of the task has the same observation."""
    task = get_task(NINE)
    sim, other = Simulation(task), Simulation(task.variant(3))
    sim.reset(20_000)
    state, poses = sim.state(), sim.fixture_poses()
    seen = ObjectSlots(sim).observe()
    other.reset(20_007)
    slots = ObjectSlots(other)
    slots.observe()
    other.set_state(state, poses)
    np.testing.assert_array_equal(slots.observe(), seen)


def test_a_highlight_marks_its_object() -> None:
    sim = started(NINE)
    chosen = next(name for name, asset in sim.assets.items() if asset.class_name == "butter")
    place = sim.body_pose(chosen)[0]
    sim.highlights = (Highlight((float(place[0]), float(place[1]), float(place[2])), 0.02),)
    rows = table(sim)
    lit = rows[field(rows, "highlighted")[:, 0] == 1]
    assert len(lit) == 1
    np.testing.assert_allclose(field(lit, "position")[0], place, atol=ROUNDED)


def test_poses_are_rounded_before_sorting() -> None:
    """A nanometre, the difference between a full and an empty drawer, changes no bit and no order."""
    sim = started(NINE)
    butters = [name for name, asset in sim.assets.items() if asset.class_name == "butter"]
    places = [sim.body_pose(name)[0] for name in butters]
    rows = []
    for nudge in (1e-9, -1e-9):
        for name, place in zip(butters, places, strict=True):
            put(sim, name, np.array([0.01234, place[1], place[2]]) + nudge * (1 if name < butters[4] else -1))
        rows.append(table(sim))
    np.testing.assert_array_equal(*rows)
    assert not np.signbit(rows[0][rows[0] == 0]).any()
