"""Labels, compared with rays, with the camera's geometry and with colours."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from lerobot_memobench.perception.objects import rays
from lerobot_memobench.perception.visual_encoder import SIDE
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from research.detector.labels import MASK, Labeller, kinds, projected
from tests.support.labelled_images import BOWLS, DRAWERS, simulation


def test_drawing_bodies_leaves_pictures_as_they_are() -> None:
    sim = simulation(BOWLS)
    before = sim.render()
    sim.data.joint("butter_1_joint0").qpos[0] += 0.1
    mujoco.mj_fwdPosition(sim.model, sim.data)
    sim.visible_bodies()
    moved = sim.render()
    sim.data.joint("butter_1_joint0").qpos[0] -= 0.1
    mujoco.mj_fwdPosition(sim.model, sim.data)
    assert (sim.render() == before).all()
    assert (moved != before).any()


@pytest.mark.parametrize("camera", MJCF_CAMERAS)
def test_the_mask_covers_what_is_projected(camera: str) -> None:
    """Butter is convex and lies free: its origin projects to the middle of what shows it."""
    sim = simulation(BOWLS)
    row = Labeller(sim).take(camera)
    butter = kinds().index("butter")
    (thing,) = (thing for thing in row["things"][: row["count"]] if thing["kind"] == butter)
    place, depth = projected(sim.body_pose("butter_1")[0], row)
    assert np.abs(place - thing["anchor"]).max() < 2 / SIDE
    x, y = (place * MASK).astype(int)
    assert row["mask"][y, x] == butter + 1
    cells = (row["mask"] == butter + 1).sum() * (256 / MASK) ** 2
    assert cells == pytest.approx(thing["pixels"], rel=0.5)
    assert 0.05 < depth < 1.5


def test_rays_undo_projection() -> None:
    sim = simulation(BOWLS)
    row = Labeller(sim).take("agentview")
    points = row["things"]["position"][: row["count"]].astype(float)
    places, depths = projected(points, row)
    assert np.allclose(row["eye"] + rays(places, row) * depths[:, None], points, atol=1e-6)


def test_drawers_are_told_apart_and_say_how_far_they_are_open() -> None:
    sim = simulation(DRAWERS)
    sim.data.joint("wooden_cabinet_1_middle_level").qpos[0] = -0.1
    mujoco.mj_fwdPosition(sim.model, sim.data)
    row = Labeller(sim).take("agentview")
    joints = {kinds()[thing["kind"]]: thing["joint"] for thing in row["things"][: row["count"]]}
    assert joints["middle_drawer"] == pytest.approx(-0.1)
    assert joints["top_drawer"] == pytest.approx(0.0, abs=0.004)
    assert np.isnan(joints["wooden_cabinet"])


def test_what_is_out_of_sight_is_not_labelled() -> None:
    sim = simulation(BOWLS)
    sim.data.joint("butter_1_joint0").qpos[2] = -3
    mujoco.mj_fwdPosition(sim.model, sim.data)
    row = Labeller(sim).take("agentview")
    assert kinds().index("butter") not in row["things"]["kind"][: row["count"]]
    assert kinds().index("akita_black_bowl") in row["things"]["kind"][: row["count"]]
