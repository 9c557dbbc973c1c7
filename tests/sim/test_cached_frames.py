"""Cached images of static rows change no pixel, in scenes of tasks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from mujoco_raster.highlights import Highlight
from mujoco_raster.rasterizer import Rasterizer

SCENES = {
    "put_the_tomato_into_the_top_drawer_of_the_cabinet": ("wooden_cabinet_1_top_level", -0.12),
    "open_and_close_the_microwave": ("microwave_1_microjoint", -1.5),
    "turn_on_the_stove_and_turn_it_off": ("flat_stove_1_button", 1.0),
}
"""A task with a fixture, and where its door, drawer or knob is open or on."""
REACH = np.array([0.6, -0.5, -0.8, 0.2, 0.0, 0.5, 1.0])


def states(sims: list[Simulation], joint: str, opened: float) -> Iterator[str]:
    """Bring simulations of one scene into states that differ in their still rows, and name them."""
    for k, sim in enumerate(sims):
        sim.reset(7 + k)
    yield "fixtures at different places"
    sims[0].step(REACH)
    sims[1].data.joint(joint).qpos[0] = opened
    mujoco.mj_step1(sims[1].model, sims[1].data)
    yield "one moved, one open"
    sims[0].highlights = (Highlight((0.1, 0.0, 0.902), 0.12),)
    yield "one highlighted"
    sims[0].set_state(sims[1].state(), sims[1].fixture_poses())
    yield "one as the other"
    sims[1].reset(9)
    yield "one reset"


@pytest.mark.parametrize("task", SCENES)
def test_frames_do_not_depend_on_caches(task: str) -> None:
    """They equal those of a new renderer, and nearly those of a renderer without static rows.

    Levels of textures are chosen per visible part of a surface, and objects in front of it may divide it.
    """
    settings = RenderSettings(128, 128)
    sims = [Simulation(get_task(task), settings) for _ in range(2)]
    sims[0].reset(7)
    drawing, draw_list = sims[0]._scene.drawing()
    others = {
        most: Rasterizer(drawing, listed, 128, 128)
        for most, listed in {0: draw_list, 2: replace(draw_list, still=0)}.items()
    }
    for state in states(sims, *SCENES[task]):
        for sim in sims:
            for name, camera in MJCF_CAMERAS.items():
                ours = sim.render(name).astype(int)
                for most, other in others.items():
                    other._still.clear()
                    model, data = sim._drawing()
                    off = np.abs(ours - other.draw(model, data, camera, sim.highlights))
                    assert off.max() <= most, f"{state}, {name}"


@pytest.mark.parametrize("place", [np.nan, 1e9])
def test_non_finite_state_is_refused(place: float) -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"), RenderSettings(32, 32))
    sim.reset(7)
    expected = sim.render()
    sim.data.joint(f"{next(iter(sim.task.objects))}_joint0").qpos[:3] = place
    for draw in (sim.render, sim.visible_bodies):
        with pytest.raises(MemobenchError, match="expected a finite state"):
            draw()
    sim.reset(7)
    np.testing.assert_array_equal(sim.render(), expected)
