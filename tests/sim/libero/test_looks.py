"""Images of the paper's world equal MuJoCo's renderer, with and without the cache."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.sim.libero.looks import drawing_model
from lerobot_memobench.sim.libero.scene import scene_spec
from lerobot_memobench.sim.raster.rasterizer import Rasterizer
from lerobot_memobench.sim.simulation import MJCF_CAMERAS
from tests.support.libero import needs_assets, simulate
from tests.support.scripts import load_script

STOVE = "turn_on_the_stove_and_turn_it_off"
BOUNDS = {"agentview": 2.5, "wrist": 3.0}
"""Mean error of 255 of a picture."""


@needs_assets
def test_the_burner_is_red_while_the_stove_is_on() -> None:
    sim = simulate(STOVE)
    sim.reset(7)
    red = []
    for knob in (0.0, 1.0, 0.0):
        sim.data.joint("flat_stove_1_button").qpos[0] = knob
        mujoco.mj_step1(sim.model, sim.data)
        picture = sim.render().astype(int)
        red.append(int((picture[..., 0] > 2 * picture[..., 1:].max(axis=2)).sum()))
    assert red[0] == red[2] < 5
    assert red[1] > 200


@needs_assets
@pytest.mark.slow
def test_cached_assets_draw_equal_images(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a writable cache, with an empty one, and with a filled one."""
    sim = simulate(STOVE)
    closed = tmp_path / "closed"
    closed.touch()
    pictures = []
    for folder in (closed, tmp_path, tmp_path):
        monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
        model, draw_list = drawing_model(scene_spec(sim.task, visuals=True))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        renderer = Rasterizer(model, draw_list, 128, 128, 0)
        pictures.append(np.stack([renderer.draw(model, data, camera) for camera in MJCF_CAMERAS.values()]))
    assert list(tmp_path.glob("lerobot_memobench/libero/*.npy"))
    np.testing.assert_array_equal(pictures[0], pictures[1])
    np.testing.assert_array_equal(pictures[1], pictures[2])


@needs_assets
@pytest.mark.slow
@pytest.mark.parametrize("name", [STOVE, "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"])
def test_looks_like_mujocos_own_renderer(mujoco_renderer: type[mujoco.Renderer], name: str) -> None:
    script = load_script("libero_looks")
    sim = script.scene(simulate(name).task, 30)
    theirs = script.mujocos(sim, script.whole_model(sim), 0)
    for camera, picture in zip(MJCF_CAMERAS, theirs, strict=True):
        assert picture.std() > 20
        assert np.abs(sim.render(camera).astype(int) - picture).mean() < BOUNDS[camera]
