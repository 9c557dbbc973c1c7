"""Frames: their content, and that they depend on the state only."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs import threads
from lerobot_memobench.sim import simulation
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from mujoco_raster.highlights import HIGHLIGHTS, Highlight
from mujoco_raster.rasterizer import Rasterizer
from tests.sim.conftest import BOWLS, DRAWER, STOVE

Simulate = Callable[..., Simulation]


def test_object_pixels_are_at_the_projected_position(simulate: Simulate) -> None:
    """The tomato's red pixels are around the projection of its origin, in both cameras."""
    sim = simulate()
    for name, camera in MJCF_CAMERAS.items():
        frame = sim.render(name).astype(int)
        red = (frame[..., 0] > 110) & (frame[..., 1] < 70) & (frame[..., 2] < 70)
        position = sim.body_pose("beefsteak_tomato__1_1")[0]
        view = sim.model.camera(camera).id
        local = sim.data.cam_xmat[view].reshape(3, 3).T @ (position - sim.data.cam_xpos[view])
        scale = 128 / np.tan(np.radians(sim.model.cam_fovy[view]) / 2)
        column, row = 128 + scale * local[0] / -local[2], 128 - scale * local[1] / -local[2]
        rows, columns = np.nonzero(red)
        near = np.hypot(rows - row, columns - column) < 14
        assert near.sum() > 30, name
        assert abs(rows[near].mean() - row) < 4, name
        assert abs(columns[near].mean() - column) < 4, name


def test_threads_have_renderers_of_their_own(simulate: Simulate) -> None:
    sim = simulate()
    expected = sim.render()
    frames: list[np.ndarray] = []

    def draw() -> None:
        mine = Simulation(get_task(DRAWER), sim.render_settings)
        mine.reset(7)
        frames.extend(mine.render() for _ in range(5))

    threads = [threading.Thread(target=draw) for _ in range(2)]
    for thread in threads:
        thread.start()
    for _ in range(5):
        frames.append(sim.render())
    for thread in threads:
        thread.join()
    assert len(frames) == 15
    for frame in frames:
        np.testing.assert_array_equal(frame, expected)


@pytest.mark.parametrize("second_core", [True, False])
def test_images_drawn_at_once_are_equal(monkeypatch: pytest.MonkeyPatch, second_core: bool) -> None:
    for module in (threads, simulation):
        monkeypatch.setattr(module, "has_second_core", lambda: second_core)
    cameras = ["agentview", "wrist"]
    sim = Simulation(get_task(DRAWER), RenderSettings(40 + second_core, 60))  # a size with rasterizers of its own
    sim.reset(7)
    expected = [sim.render(camera) for camera in cameras]
    for _ in range(3):
        np.testing.assert_array_equal(sim.render_cameras(cameras), expected)
        np.testing.assert_array_equal(sim.render_cameras(cameras[::-1]), expected[::-1])


def test_highlights_are_drawn_and_go_away(simulate: Simulate) -> None:
    sim = simulate(BOWLS)
    plain = sim.render()
    sim.highlights = (Highlight((0.1, 0.0, 0.902), 0.12), Highlight((-0.2, 0.2, 0.902), 0.05, (0.1, 0.2, 1.0, 0.5)))
    marked = sim.render()
    changed = np.abs(marked.astype(int) - plain).max(axis=2) > 20
    assert 0.01 < changed.mean() < 0.3
    sim.highlights = ()
    np.testing.assert_array_equal(sim.render(), plain)
    sim.highlights = (Highlight((0, 0, 0.9), 0.1),) * (HIGHLIGHTS + 1)
    with pytest.raises(MemobenchError, match=f"at most {HIGHLIGHTS}"):
        sim.render()


def test_an_unknown_camera_is_an_error(simulate: Simulate) -> None:
    with pytest.raises(MemobenchError, match=r"'agentwiev'.*'agentview'"):
        simulate().render("agentwiev")


# --- caches ---

SCENES = {
    DRAWER: ("wooden_cabinet_1_top_level", -0.12),
    "open_and_close_the_microwave": ("microwave_1_microjoint", -1.5),
    STOVE: ("flat_stove_1_button", 1.0),
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


# --- other processes ---

_FRAME = """
import hashlib, os, sys
from lerobot_memobench.jobs import threads
from lerobot_memobench.sim.simulation import RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task

def show():
    content = sim.state().tobytes() + sim.render().tobytes() + sim.render("wrist").tobytes()
    os.write(1, f"{hashlib.sha256(content).hexdigest()}\\n".encode())  # one write: forks share the pipe

sim = Simulation(get_task(sys.argv[1]), RenderSettings(quality=sys.argv[2]))
sim.reset(7)
for _ in range(int(sys.argv[3])):  # fork before and after a frame
    child = os.fork()
    show()
    if not child:
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
show()
print("OpenGL.GL" in sys.modules)
"""


def frame_hashes(quality: str, forks: int = 0, **variables: str) -> list[str]:
    """Return the hashes of state and frames in a new process and its forks, and whether OpenGL was loaded."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _FRAME, STOVE, quality, str(forks)],
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.split()


def own_hash(quality: str) -> str:
    sim = Simulation(get_task(STOVE), RenderSettings(quality=quality))
    sim.reset(7)
    return hashlib.sha256(sim.state().tobytes() + sim.render().tobytes() + sim.render("wrist").tobytes()).hexdigest()


@pytest.mark.parametrize("quality", ["default", pytest.param("high", marks=pytest.mark.slow)])
def test_frames_are_equal_in_every_process_without_gl(quality: str) -> None:
    """Independent of threads, forks and MUJOCO_GL."""
    variables = {"OMP_NUM_THREADS": "3", "NUMBA_NUM_THREADS": "2", "MUJOCO_GL": "glfw", "DISPLAY": ""}
    assert frame_hashes(quality, 2, **variables) == [own_hash(quality)] * 5 + ["False"]


@pytest.mark.slow
@pytest.mark.parametrize("variables", [{"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}, {"NUMBA_OPT": "0"}])
def test_states_and_frames_are_equal_on_another_processor(variables: dict[str, str], tmp_path: Path) -> None:
    """Compiled without this processor's vector instructions, and without optimisation."""
    assert frame_hashes("default", NUMBA_CACHE_DIR=str(tmp_path), **variables) == [own_hash("default"), "False"]
