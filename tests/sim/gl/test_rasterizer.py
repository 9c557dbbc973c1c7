"""What the shaders read has the layout that they expect."""

from __future__ import annotations

import ctypes

import numpy as np

from lerobot_memobench.sim.gl.rasterizer import MultisampleRasterizer
from lerobot_memobench.sim.gl.shaders import frame_block
from lerobot_memobench.sim.rendering import RenderSettings, make_renderer
from lerobot_memobench.sim.worlds import get_scene
from lerobot_memobench.tasks.catalogue import get_task


def test_what_the_shaders_read_has_their_layout(gl: str) -> None:
    """The driver's own offsets of the block's parts are those that are written."""
    scene = get_scene(get_task("turn_on_the_stove_and_turn_it_off"))
    rasterizer = make_renderer(scene.model, RenderSettings(32, 32, "high"))
    assert isinstance(rasterizer, MultisampleRasterizer)
    from OpenGL import GL

    program, block = rasterizer._program, rasterizer._block
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
    rasterizer.free()
