"""A frame costs no wrapper, and what a driver refuses is told."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim import rendering
from lerobot_memobench.sim.gl.rasterizer import Rasterizer
from lerobot_memobench.sim.gl.shaders import frame_block
from lerobot_memobench.sim.rendering import QUALITIES, Highlight, RenderSettings
from lerobot_memobench.sim.simulation import NO_OP, Simulation
from lerobot_memobench.tasks.catalogue import get_task

STOVE = "turn_on_the_stove_and_turn_it_off"


def rasterizers() -> list[Rasterizer]:
    found = [renderer._rasterizer for renderer in rendering._thread.renderers.values()]
    assert found
    return [rasterizer for rasterizer in found if rasterizer is not None]


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
