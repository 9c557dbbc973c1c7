"""A frame costs no wrapper, and what a driver refuses is told."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import rendering
from lerobot_memobench.sim.gl.drawlist import DrawList, build_draw_list
from lerobot_memobench.sim.gl.rasterizer import Highlight, Rasterizer
from lerobot_memobench.sim.gl.shaders import frame_block
from lerobot_memobench.sim.rendering import QUALITIES, ROOM, RenderSettings, make_renderer
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"


def rasterizers() -> list[Rasterizer]:
    found = list(rendering._thread.renderers.values())
    assert found
    return found


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_frame_goes_around_pyopengls_wrappers(gl: str, quality: str) -> None:
    sim = Simulation(get_task(STOVE), RenderSettings(64, 64, quality))
    sim.reset(7)
    sim.render()
    from OpenGL import GL

    constants = SimpleNamespace(**{name: value for name, value in vars(GL).items() if name.startswith("GL_")})
    for rasterizer in rasterizers():
        for part in (rasterizer, rasterizer._resources, rasterizer._shadows):
            if part is not None:
                part._gl = constants
    sim.step(NO_OP)
    sim.highlights = (Highlight((0.0, 0.0, 0.902), 0.1),)
    assert sim.render().std() > 10
    for rasterizer in rasterizers():
        rasterizer._gl = rasterizer._resources._gl = GL  # set up and freed with them


def test_an_error_of_the_driver_is_told(gl: str, simulate: Callable[..., Simulation]) -> None:
    sim = simulate(STOVE)
    expected = sim.render()
    [rasterizer] = rasterizers()
    rasterizer._call.glEnable(0)  # no such thing: what any refused call leaves behind
    with pytest.raises(MemobenchError, match=r"failed to draw a frame \(error 0x0500\).*memobench doctor"):
        sim.render()
    np.testing.assert_array_equal(sim.render(), expected)


def test_what_the_shaders_are_told_has_their_layout(gl: str, simulate: Callable[..., Simulation]) -> None:
    """The driver's own offsets of the block's parts are those that are written."""
    simulate(STOVE).render()
    [rasterizer] = rasterizers()
    from OpenGL import GL

    program, block = rasterizer._program, rasterizer._view.block
    assert block.dtype == frame_block(block["light_to"].shape[0])
    size = np.zeros(1, dtype=np.int32)
    GL.glGetActiveUniformBlockiv(program, 0, GL.GL_UNIFORM_BLOCK_DATA_SIZE, size)
    assert size[0] == block.nbytes
    for name in block.dtype.names:
        active = f"{name}[0]" if name.startswith("light_") else name
        names = (ctypes.POINTER(ctypes.c_char) * 1)(ctypes.create_string_buffer(active.encode()))
        index, offset = ctypes.c_uint(), ctypes.c_int()
        GL.glGetUniformIndices(program, 1, names, index)
        GL.glGetActiveUniformsiv(program, 1, index, GL.GL_UNIFORM_OFFSET, offset)
        assert offset.value == block.dtype.fields[name][1], name


# --- shadows: what is kept from frame to frame, and the order of drawing, change no pixel ---

SCENES = {
    "put_the_tomato_into_the_top_drawer_of_the_cabinet": ("wooden_cabinet_1_top_level", -0.12),
    "open_and_close_the_microwave": ("microwave_1_microjoint", -1.5),
    "turn_on_the_stove_and_turn_it_off": ("flat_stove_1_button", 1.0),
}
"""A task with a fixture, and where its door, drawer or knob is open or on."""
EVERY_TIME = {*((task, "default") for task in SCENES), (next(iter(SCENES)), "fast")}
REACH = np.array([0.6, -0.5, -0.8, 0.2, 0.0, 0.5, 1.0])


def plain(model: mujoco.MjModel, finer: mujoco.MjModel | None) -> DrawList:
    """Return a draw list in the model's order in which all that casts shadows is drawn for each state."""
    listed = build_draw_list(model, (), ROOM, finer)
    none = np.zeros(0, dtype=np.int64)
    casters = np.concatenate([listed.still, listed.moving])
    return replace(listed, still=none.astype(np.uint32), moving=casters, still_rows=none)


def states(sims: list[Simulation], joint: str, opened: float) -> Iterator[str]:
    """Bring simulations of one scene into states that differ in what casts shadows, and name them."""
    for k, sim in enumerate(sims):
        sim.reset(7 + k)
    yield "fixtures at two places"
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


@pytest.mark.parametrize(
    ("task", "quality"),
    [
        pytest.param(task, quality, marks=() if (task, quality) in EVERY_TIME else pytest.mark.slow)
        for task in SCENES
        for quality in QUALITIES
    ],
)
def test_frames_equal_those_drawn_plainly(gl: str, monkeypatch: pytest.MonkeyPatch, task: str, quality: str) -> None:
    settings = RenderSettings(128, 128, quality)
    sims = [Simulation(get_task(task), settings) for _ in range(2)]
    sims[0].render()  # opens the context, and the renderer that both share
    with monkeypatch.context() as patch:
        patch.setattr(rendering, "build_draw_list", lambda model, _background, _shadowless, finer: plain(model, finer))
        reference = make_renderer(sims[0].model, settings)
    for state in states(sims, *SCENES[task]):
        for sim in sims:
            for name, camera in MJCF_CAMERAS.items():
                ours = sim.render(name)
                theirs = reference.draw(sim.model, sim.data, camera, sim.highlights)
                np.testing.assert_array_equal(ours, theirs, err_msg=f"{state}, {name}")


def test_casters_are_parted_by_whether_they_can_move() -> None:
    """A door, the hand and what stands on the table move; the microwave's body and the arm's foot do not."""
    sim = Simulation(get_task("open_and_close_the_microwave"))
    listed = build_draw_list(sim.model, rendering.BACKGROUND, ROOM)

    def bodies(indices: np.ndarray) -> set[str]:
        rows = listed.vertices["geom"][indices].astype(int)
        return {sim.model.body(sim.model.geom_bodyid[listed.geoms[row]]).name for row in np.unique(rows)}

    still, moving = bodies(listed.still), bodies(listed.moving)
    assert {"microwave_1", "robot0_link0", "mount0_pedestal"} <= still
    assert {"robot0_link1", "white_bowl_1", "plate_1"} <= moving
    assert {body for body in moving if body.startswith("microwave_1_")}, "its door"
    assert not (still | moving) & set(ROOM)


def test_what_stands_behind_is_drawn_last() -> None:
    sim = Simulation(get_task("open_and_close_the_microwave"))
    listed = build_draw_list(sim.model, rendering.BACKGROUND, ROOM)
    names = [sim.model.body(body).name for body in sim.model.geom_bodyid[listed.geoms]]
    assert list(dict.fromkeys(names))[-len(rendering.BACKGROUND) :] == list(rendering.BACKGROUND)
    np.testing.assert_array_equal(np.unique(listed.vertices["geom"]), np.arange(len(listed.geoms)))
