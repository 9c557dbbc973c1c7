"""Draw a `DrawList` with OpenGL, several samples per pixel: a shadow map and one draw call per frame.

The light is MuJoCo's: a headlight with ambience, parallel lights, Blinn's highlights, textures that modulate all of it.
Shadows are those of the first parallel light that casts them, with soft edges.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.sim.gl.context import context_is_open, enter_context
from lerobot_memobench.sim.gl.resources import Resources
from lerobot_memobench.sim.gl.shaders import ATTRIBUTES, TEXTURE_UNITS, frame_block, scene_program, shadow_program
from lerobot_memobench.sim.raster.drawlist import VERTEX, DrawList, Image
from lerobot_memobench.sim.raster.highlights import HIGHLIGHTS, Highlight, fill_table, table_of, with_discs
from lerobot_memobench.sim.raster.lights import Lamps
from lerobot_memobench.sim.raster.textures import LAYER_SIZE
from lerobot_memobench.sim.raster.view import camera_matrix


class MultisampleRasterizer:
    """GL objects for one draw list in this thread's context.

    Args:
        model: where lights and clipping planes are read from.
        draw_list: what there is to draw.
        width, height: size of the frames, pixels.
        samples: samples per pixel.
        shadow_size: side of the shadow map, pixels.
    """

    def __init__(
        self, model: mujoco.MjModel, draw_list: DrawList, width: int, height: int, samples: int, shadow_size: int
    ) -> None:
        enter_context()
        from OpenGL import GL

        self._gl, self._list, self._width, self._height = GL, draw_list, width, height
        self._shadow_size = shadow_size
        self._resources = Resources(GL, width, height)
        self._lamps = Lamps(model, shadows=bool(draw_list.casting.any()))
        self._block: NDArray[Any] = np.zeros((), dtype=frame_block(len(self._lamps.lights.to)))
        self._make_vertices()
        self._make_tables()
        self._make_textures()
        self._make_targets(min(samples, int(GL.glGetIntegerv(GL.GL_MAX_SAMPLES))))
        if self._lamps.caster is not None:
            self._make_shadow_map()
            self._shadow_program = self._resources.program(shadow_program(GL))
        caster = self._lamps.lights.caster
        self._program = self._resources.program(scene_program(GL, len(self._lamps.lights.to), caster))

    # --- set up ---------------------------------------------------------------------------------------------

    def _make_vertices(self) -> None:
        """Upload the scene's triangles and those of the highlights, and behind them the shadows' casters again."""
        GL = self._gl
        vertices, triangles = with_discs(self._list)
        self._scene_size = 3 * len(self._list.triangles)
        self._disc_size = 3 * (len(triangles) - len(self._list.triangles)) // HIGHLIGHTS
        row = self._list.vertices["row"][self._list.triangles[:, 0]].astype(np.int64)
        casters = self._list.triangles[self._list.casting[row]]
        self._first_caster, self._casters = triangles.size, casters.size
        self._array = self._resources.vertex_array()
        self._resources.buffer(GL.GL_ARRAY_BUFFER, vertices.view(np.uint8), GL.GL_STATIC_DRAW)
        indices = np.concatenate([triangles, casters]).astype(np.uint32)
        self._resources.buffer(GL.GL_ELEMENT_ARRAY_BUFFER, indices, GL.GL_STATIC_DRAW)
        for location, name in enumerate(ATTRIBUTES):
            kind, offset = VERTEX.fields[name][:2]  # type: ignore[index]
            count = int(np.prod(kind.shape)) if kind.shape else 1
            GL.glEnableVertexAttribArray(location)
            GL.glVertexAttribPointer(
                location, count, GL.GL_FLOAT, GL.GL_FALSE, VERTEX.itemsize, ctypes.c_void_p(offset)
            )

    def _make_tables(self) -> None:
        """Make what the shaders read of each row, a texture, and of the view, a block; `draw` fills both."""
        GL = self._gl
        self._table = table_of(self._list)
        self._table_buffer = self._resources.buffer(GL.GL_TEXTURE_BUFFER, self._table, GL.GL_STREAM_DRAW)
        self._resources.texture(TEXTURE_UNITS["rows"], GL.GL_TEXTURE_BUFFER)
        GL.glTexBuffer(GL.GL_TEXTURE_BUFFER, GL.GL_RGBA32F, self._table_buffer)
        self._view_buffer = self._resources.buffer(GL.GL_UNIFORM_BUFFER, self._block, GL.GL_STREAM_DRAW)

    def _make_textures(self) -> None:
        GL = self._gl
        self._resources.texture(TEXTURE_UNITS["textures"], GL.GL_TEXTURE_2D_ARRAY)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        layers = np.ascontiguousarray(self._list.layers)
        GL.glTexImage3D(
            GL.GL_TEXTURE_2D_ARRAY, 0, GL.GL_RGB8, LAYER_SIZE, LAYER_SIZE, len(layers), 0, GL.GL_RGB,
            GL.GL_UNSIGNED_BYTE, layers,
        )  # fmt: skip
        GL.glGenerateMipmap(GL.GL_TEXTURE_2D_ARRAY)
        self._resources.sample(GL.GL_TEXTURE_2D_ARRAY, GL.GL_LINEAR_MIPMAP_LINEAR, GL.GL_REPEAT)

    def _make_targets(self, samples: int) -> None:
        """Make framebuffers: one of several samples per pixel to draw into, one of single samples to read."""
        GL, make, size = self._gl, self._resources, (self._width, self._height)
        self._target = make.framebuffer()
        make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, samples, size)
        make.renderbuffer(GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT, samples, size)
        make.check_framebuffer()
        self._result = make.framebuffer()
        make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, 0, size)
        make.check_framebuffer()

    def _make_shadow_map(self) -> None:
        """Make the texture of the depths that the caster sees."""
        GL, size = self._gl, self._shadow_size
        self._shadow_target = self._resources.framebuffer()
        texture = self._resources.texture(TEXTURE_UNITS["shadows"], GL.GL_TEXTURE_2D)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D, 0, GL.GL_DEPTH_COMPONENT16, size, size, 0, GL.GL_DEPTH_COMPONENT,
            GL.GL_UNSIGNED_SHORT, None,
        )  # fmt: skip
        self._resources.sample(GL.GL_TEXTURE_2D, GL.GL_LINEAR, GL.GL_CLAMP_TO_BORDER)
        GL.glTexParameterfv(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_BORDER_COLOR, (1.0, 1.0, 1.0, 1.0))
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_MODE, GL.GL_COMPARE_REF_TO_TEXTURE)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_FUNC, GL.GL_LEQUAL)
        GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_TEXTURE_2D, texture, 0)
        GL.glDrawBuffer(GL.GL_NONE)
        GL.glReadBuffer(GL.GL_NONE)
        self._resources.check_framebuffer()

    # --- draw -----------------------------------------------------------------------------------------------

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return what a camera sees, (height, width, 3) uint8, first row on top.

        Args:
            model: an instance of the model that the draw list was made of.
            data: the state to show.
            camera: its name.
            highlights: drawn in this order.
        """
        fill_table(self._table, self._list, model, data, highlights)
        self._look(model, data, int(model.camera(camera).id))
        enter_context()
        self._enter()
        if self._lamps.caster is not None:
            self._draw_shadows()
        self._draw_scene()
        if highlights:
            self._draw_discs(len(highlights))
        return self._read()

    def _look(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> None:
        """Fill the block with a camera's view of a state."""
        block, lights = self._block, self._lamps.look(data, camera)
        # The shaders keep matrices by columns.
        block["projection"] = camera_matrix(model, data, camera, self._height, self._width).T
        block["light"] = self._lamps.light_matrix(model, data).T
        block["eye"][:3] = data.cam_xpos[camera]
        block["ambient"][:3] = lights.ambient.sum(axis=0)
        block["light_to"][:, :3] = lights.to
        block["light_diffuse"][:, :3] = lights.diffuse
        block["light_specular"][:, :3] = lights.specular

    def _enter(self) -> None:
        """Set the context's state, which other renderers share, and send the frame's tables."""
        GL = self._gl
        GL.glBindVertexArray(self._array)
        self._resources.bind_textures()
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glBindBufferBase(GL.GL_UNIFORM_BUFFER, 0, self._view_buffer)  # 0 is where a program's first block reads
        GL.glBufferData(GL.GL_UNIFORM_BUFFER, self._block.nbytes, self._block, GL.GL_STREAM_DRAW)
        GL.glBindBuffer(GL.GL_TEXTURE_BUFFER, self._table_buffer)
        GL.glBufferData(GL.GL_TEXTURE_BUFFER, self._table.nbytes, self._table, GL.GL_STREAM_DRAW)

    def _draw_shadows(self) -> None:
        GL = self._gl
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._shadow_target)
        GL.glViewport(0, 0, self._shadow_size, self._shadow_size)
        GL.glClear(GL.GL_DEPTH_BUFFER_BIT)
        GL.glUseProgram(self._shadow_program)
        GL.glFrontFace(GL.GL_CCW)
        # Pushed away from the light by more than a texel's slope, or surfaces would speckle themselves.
        GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glPolygonOffset(2.0, 4.0)
        self._draw_elements(self._first_caster, self._casters)
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)

    def _draw_scene(self) -> None:
        GL = self._gl
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._target)
        GL.glViewport(0, 0, self._width, self._height)
        GL.glClearColor(0.0, 0.0, 0.0, 1.0)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        GL.glUseProgram(self._program)
        GL.glFrontFace(GL.GL_CW)  # frames are drawn upside down
        self._draw_elements(0, self._scene_size)

    def _draw_discs(self, count: int) -> None:
        GL = self._gl
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
        GL.glDepthMask(GL.GL_FALSE)
        self._draw_elements(self._scene_size, count * self._disc_size)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glDisable(GL.GL_BLEND)

    def _draw_elements(self, first: int, count: int) -> None:
        self._gl.glDrawElements(self._gl.GL_TRIANGLES, count, self._gl.GL_UNSIGNED_INT, ctypes.c_void_p(4 * first))

    def _read(self) -> Image:
        """Make one sample of a pixel's several, and return them."""
        GL, size = self._gl, (self._width, self._height)
        GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._target)
        GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._result)
        GL.glBlitFramebuffer(0, 0, *size, 0, 0, *size, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._result)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        image = np.empty((self._height, self._width, 3), dtype=np.uint8)
        GL.glReadPixels(0, 0, *size, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, image)
        return image

    def free(self) -> None:
        """Delete all GL objects, where the context that they were made in is still open."""
        if context_is_open():
            enter_context()
            self._resources.free()
