"""What a light sees: the depths of all that casts shadows, of which only what has moved is drawn anew."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from lerobot_memobench.sim.drawing.drawlist import DrawList, Floats
from lerobot_memobench.sim.drawing.resources import Resources
from lerobot_memobench.sim.drawing.shaders import TEXTURE_UNITS, shadow_program


class ShadowMap:
    """The shadow map of one light, and the depths of the casters that cannot move, kept beside it.

    Args:
        GL: PyOpenGL's module; a context is current.
        call: the functions of a frame.
        resources: where GL objects are made, and freed with the rest.
        draw_list: what there is to draw.
        size: side of the map, pixels.
        first: where the still casters' indices begin in the buffer of indices; the moving ones' follow them.
    """

    def __init__(
        self, GL: Any, call: SimpleNamespace, resources: Resources, draw_list: DrawList, size: int, first: int
    ) -> None:
        self._gl, self._call, self._list, self._size, self._first = GL, call, draw_list, size, first
        self._still = resources.framebuffer()
        resources.renderbuffer(GL.GL_DEPTH_COMPONENT16, GL.GL_DEPTH_ATTACHMENT, 0, (size, size))
        self._finish_framebuffer(resources)
        self._all = resources.framebuffer()
        self._make_texture(resources)
        self._finish_framebuffer(resources)
        self._program = resources.program(shadow_program(GL))
        self._kept: bytes | None = None

    def _make_texture(self, resources: Resources) -> None:
        GL, size = self._gl, self._size
        texture = resources.texture(TEXTURE_UNITS["shadows"], GL.GL_TEXTURE_2D)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D, 0, GL.GL_DEPTH_COMPONENT16, size, size, 0, GL.GL_DEPTH_COMPONENT,
            GL.GL_UNSIGNED_SHORT, None,
        )  # fmt: skip
        resources.sample(GL.GL_TEXTURE_2D, GL.GL_LINEAR, GL.GL_CLAMP_TO_BORDER)
        GL.glTexParameterfv(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_BORDER_COLOR, (1.0, 1.0, 1.0, 1.0))
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_MODE, GL.GL_COMPARE_REF_TO_TEXTURE)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_FUNC, GL.GL_LEQUAL)
        GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_TEXTURE_2D, texture, 0)

    def _finish_framebuffer(self, resources: Resources) -> None:
        self._gl.glDrawBuffer(self._gl.GL_NONE)
        self._gl.glReadBuffer(self._gl.GL_NONE)
        resources.check_framebuffer()

    def draw(self, table: Floats, light: Floats) -> None:
        """Bring the map up to date.

        Args:
            table: poses of the geoms, (rows, ROWS, 4), as the shader was told them.
            light: from the world to the light's clip space, (4, 4), as the shader was told it.
        """
        GL, call, size = self._gl, self._call, self._size
        call.glViewport(0, 0, size, size)
        call.glUseProgram(self._program)
        call.glFrontFace(GL.GL_CCW)
        # Pushed away from the light by more than a texel's slope, or surfaces would speckle themselves.
        call.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        call.glPolygonOffset(2.0, 4.0)
        # What cannot move in an episode still stands elsewhere after a reset, and in another simulation of the scene.
        kept = table[self._list.still_rows, :3].tobytes() + light.tobytes()
        if kept != self._kept:
            self._kept = kept
            call.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._still)
            call.glClear(GL.GL_DEPTH_BUFFER_BIT)
            self._draw(self._first, self._list.still.size)
        call.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._still)
        call.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._all)
        call.glBlitFramebuffer(0, 0, size, size, 0, 0, size, size, GL.GL_DEPTH_BUFFER_BIT, GL.GL_NEAREST)
        # The nearest depth of a texel is the same whoever is drawn first.
        self._draw(self._first + self._list.still.size, self._list.moving.size)
        call.glDisable(GL.GL_POLYGON_OFFSET_FILL)

    def _draw(self, first: int, count: int) -> None:
        GL = self._gl
        self._call.glDrawElements(GL.GL_TRIANGLES, count, GL.GL_UNSIGNED_INT, 4 * first)
