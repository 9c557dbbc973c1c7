"""GL objects that are made together and freed together."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError


class Resources:
    """Buffers, textures and framebuffers of the context that is current when they are made.

    Args:
        GL: PyOpenGL's module: it fixes its platform on import, so only who has a context imports it.
        width, height: size of the frames, pixels.
    """

    def __init__(self, GL: Any, width: int, height: int) -> None:
        self._gl, self.width, self.height = GL, width, height
        self._arrays: list[int] = []
        self._buffers: list[int] = []
        self._textures: list[tuple[int, Any, int]] = []
        self._renderbuffers: list[int] = []
        self._frames: list[int] = []
        self._programs: list[int] = []

    def program(self, program: int) -> int:
        """Free a compiled program with the rest; return it."""
        self._programs.append(program)
        return program

    def vertex_array(self) -> int:
        """Make a vertex array and bind it."""
        name = int(self._gl.glGenVertexArrays(1))
        self._arrays.append(name)
        self._gl.glBindVertexArray(name)
        return name

    def buffer(self, target: Any, content: NDArray[Any], usage: Any) -> int:
        """Make a buffer that holds an array, and leave it bound."""
        GL = self._gl
        name = int(GL.glGenBuffers(1))
        self._buffers.append(name)
        GL.glBindBuffer(target, name)
        GL.glBufferData(target, content.nbytes, np.ascontiguousarray(content), usage)
        return name

    def texture(self, unit: int, target: Any) -> int:
        """Make a texture and bind it to its unit, where `bind_textures` puts it before every frame."""
        name = int(self._gl.glGenTextures(1))
        self._textures.append((unit, target, name))
        self._bind(unit, target, name)
        return name

    def sample(self, target: Any, minify: Any, wrap: Any) -> None:
        """Say how the texture that is bound is read between and beyond its texels."""
        GL = self._gl
        GL.glTexParameteri(target, GL.GL_TEXTURE_MIN_FILTER, minify)
        GL.glTexParameteri(target, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
        GL.glTexParameteri(target, GL.GL_TEXTURE_WRAP_S, wrap)
        GL.glTexParameteri(target, GL.GL_TEXTURE_WRAP_T, wrap)

    def bind_textures(self) -> None:
        """Bind every texture to its unit: another renderer of this context may have put its own there."""
        for unit, target, name in self._textures:
            self._bind(unit, target, name)

    def _bind(self, unit: int, target: Any, name: int) -> None:
        self._gl.glActiveTexture(self._gl.GL_TEXTURE0 + unit)
        self._gl.glBindTexture(target, name)

    def framebuffer(self) -> int:
        """Make a framebuffer and bind it."""
        name = int(self._gl.glGenFramebuffers(1))
        self._frames.append(name)
        self._gl.glBindFramebuffer(self._gl.GL_FRAMEBUFFER, name)
        return name

    def renderbuffer(self, kind: Any, attachment: Any, samples: int, size: tuple[int, int]) -> None:
        """Give the framebuffer that is bound a place for pixels or depths of a width and height."""
        GL = self._gl
        name = int(GL.glGenRenderbuffers(1))
        self._renderbuffers.append(name)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, name)
        GL.glRenderbufferStorageMultisample(GL.GL_RENDERBUFFER, samples, kind, *size)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, name)

    def check_framebuffer(self) -> None:
        """Raise `MemobenchError` where the driver cannot draw into the framebuffer that is bound."""
        GL = self._gl
        status = GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER)
        if status != GL.GL_FRAMEBUFFER_COMPLETE:
            raise MemobenchError(
                f"the GL driver cannot draw {self.width}×{self.height} frames (framebuffer status {status}); try "
                "env.render=default or another MUJOCO_GL, and see `memobench doctor`"
            )

    def free(self) -> None:
        """Delete all; the context they were made in must be current."""
        GL = self._gl
        for program in self._programs:
            GL.glDeleteProgram(program)
        for delete, names in (
            (GL.glDeleteVertexArrays, self._arrays),
            (GL.glDeleteBuffers, self._buffers),
            (GL.glDeleteTextures, [name for _, _, name in self._textures]),
            (GL.glDeleteRenderbuffers, self._renderbuffers),
            (GL.glDeleteFramebuffers, self._frames),
        ):
            if names:
                delete(len(names), names)
