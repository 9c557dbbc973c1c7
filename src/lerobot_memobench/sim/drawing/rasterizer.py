"""Draw a `DrawList` with OpenGL: one shadow map per state, one draw call per camera.

The light is MuJoCo's: a headlight with ambience, directional lights, Blinn's highlights, textures that modulate all of
it. Shadows are those of the first directional light that casts them, with soft edges.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.drawing.drawlist import LAYER_SIZE, ROWS, VERTEX, DrawList, Floats
from lerobot_memobench.sim.drawing.resources import Resources
from lerobot_memobench.sim.drawing.shaders import ATTRIBUTES, TEXTURE_UNITS, scene_program
from lerobot_memobench.sim.drawing.shadows import ShadowMap
from lerobot_memobench.sim.drawing.shapes import disc
from lerobot_memobench.sim.drawing.views import camera_matrix, light_matrix

Image = NDArray[np.uint8]
Disc = tuple[NDArray[np.floating], float, float, Sequence[float]]
"""A translucent disc: position (3,), radius, half height, m, and rgba."""

HIGHLIGHTS = 16
"""Translucent discs that fit into a frame."""

_UNIFORMS = ("projection", "light", "eye", "ambient", "light_to", "light_diffuse", "light_specular")


class Rasterizer:
    """GL objects for one draw list in the current context.

    Args:
        model: where lights and clipping planes are read from.
        draw_list: what there is to draw.
        width, height: size of the frames, pixels.
        samples: samples per pixel; 0 for one without multisampling.
        shadow_size: side of the shadow map, pixels; 0 draws no shadows.
    """

    def __init__(
        self, model: mujoco.MjModel, draw_list: DrawList, width: int, height: int, samples: int, shadow_size: int
    ) -> None:
        from OpenGL import GL

        self._gl = GL
        self._list, self._width, self._height = draw_list, width, height
        self._lights = [
            i
            for i in range(model.nlight)
            if model.light_active[i] and model.light_type[i] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
        ]
        casting = [i for i in self._lights if model.light_castshadow[i]]
        casters = draw_list.still.size + draw_list.moving.size
        self._caster = casting[0] if casting and shadow_size and casters else None
        self._resources = Resources(GL, width, height)
        self._sent: bytes | None = None
        self._make_vertices()
        self._make_table()
        self._make_textures()
        self._make_targets(samples)
        self._shadows: ShadowMap | None = None
        if self._caster is not None:
            self._shadows = ShadowMap(GL, self._resources, draw_list, shadow_size, draw_list.indices.size)
        self._make_program()

    # --- set up ---------------------------------------------------------------------------------------------

    def _make_vertices(self) -> None:
        """Upload the scene's triangles and, behind them, one disc per highlight, each with its row of the table.

        The buffer of indices holds what a camera sees, the shadows' casters again, and the discs.
        """
        GL = self._gl
        positions, normals, uv, triangles = disc()
        discs = np.zeros((HIGHLIGHTS, len(positions)), dtype=VERTEX)
        discs["position"], discs["normal"], discs["uv"] = positions, normals, uv
        discs["geom"] = len(self._list.geoms) + np.arange(HIGHLIGHTS)[:, None]
        steps = len(self._list.vertices) + len(positions) * np.arange(HIGHLIGHTS)[:, None]
        disc_indices = (triangles.reshape(1, -1) + steps).astype(np.uint32)
        self._disc_size = int(triangles.size)
        vertices = np.concatenate([self._list.vertices, discs.ravel()])
        scene = (self._list.indices, self._list.still, self._list.moving)
        self._first_disc = sum(part.size for part in scene)
        indices = np.concatenate([*scene, disc_indices.ravel()])

        self._array = self._resources.vertex_array()
        self._resources.buffer(GL.GL_ARRAY_BUFFER, vertices.view(np.uint8), GL.GL_STATIC_DRAW)
        self._resources.buffer(GL.GL_ELEMENT_ARRAY_BUFFER, indices, GL.GL_STATIC_DRAW)
        for location, name in enumerate(ATTRIBUTES):
            kind, offset = VERTEX.fields[name][:2]  # type: ignore[index]
            count = int(np.prod(kind.shape)) if kind.shape else 1
            GL.glEnableVertexAttribArray(location)
            GL.glVertexAttribPointer(
                location, count, GL.GL_FLOAT, GL.GL_FALSE, VERTEX.itemsize, ctypes.c_void_p(offset)
            )

    def _make_table(self) -> None:
        """Make the texture that tells the shader of each geom; `_send` fills it."""
        GL = self._gl
        self._table = np.zeros((len(self._list.geoms) + HIGHLIGHTS, ROWS, 4), dtype=np.float32)
        self._table_buffer = self._resources.buffer(GL.GL_TEXTURE_BUFFER, self._table, GL.GL_STREAM_DRAW)
        self._resources.texture(TEXTURE_UNITS["geoms"], GL.GL_TEXTURE_BUFFER)
        GL.glTexBuffer(GL.GL_TEXTURE_BUFFER, GL.GL_RGBA32F, self._table_buffer)

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
        """Make what is drawn into, and what is read from where that has several samples per pixel."""
        GL, make = self._gl, self._resources
        samples = min(samples, int(GL.glGetIntegerv(GL.GL_MAX_SAMPLES)))
        self._target = make.framebuffer()
        size = (self._width, self._height)
        make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, samples, size)
        make.renderbuffer(GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT, samples, size)
        make.check_framebuffer()
        self._result = self._target
        if samples:
            self._result = make.framebuffer()
            make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, 0, size)
            make.check_framebuffer()

    def _make_program(self) -> None:
        GL = self._gl
        # The headlight goes first.
        caster = None if self._caster is None else 1 + self._lights.index(self._caster)
        self._program = self._resources.program(scene_program(GL, 1 + len(self._lights), caster))
        self._at = {name: GL.glGetUniformLocation(self._program, name) for name in _UNIFORMS}

    # --- draw -----------------------------------------------------------------------------------------------

    def draw(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int, discs: Sequence[Disc] = ()) -> Image:
        """Return what a camera sees, (height, width, 3) uint8, first row on top.

        Args:
            model: an instance of the model that the draw list was made of.
            data: the state to show.
            camera: its id.
            discs: translucent discs, drawn in this order.
        """
        if len(discs) > HIGHLIGHTS:
            raise MemobenchError(f"there are {len(discs)} highlights in a frame; at most {HIGHLIGHTS} can be drawn")
        self._enter()
        light = np.eye(4, dtype=np.float32) if self._caster is None else light_matrix(model, data, self._caster)
        if self._send(model, data, discs) and self._shadows is not None:
            self._shadows.draw(self._table, light)
        self._draw_scene(model, data, camera, light)
        if discs:
            self._draw_discs(len(discs))
        return self._read()

    def _enter(self) -> None:
        """Set the context's state, which other renderers share."""
        GL = self._gl
        GL.glBindVertexArray(self._array)
        self._resources.bind_textures()
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glDepthMask(GL.GL_TRUE)

    def _send(self, model: mujoco.MjModel, data: mujoco.MjData, discs: Sequence[Disc]) -> bool:
        """Bring the table up to date; return whether it had to be, False where the last frame was of the same state."""
        GL = self._gl
        rows = len(self._list.geoms)
        self._table[:rows] = self._list.table(model, data)
        for k, (position, radius, half_height, rgba) in enumerate(discs):
            row = self._table[rows + k]
            row[:3] = np.diag([radius, radius, half_height]) @ np.eye(3, 4)
            row[:3, 3] = position
            row[3], row[4] = rgba, (0.0, 1.0, 0.3, 0.0)
        state = self._table.tobytes()
        if state == self._sent:
            return False
        self._sent = state
        GL.glBindBuffer(GL.GL_TEXTURE_BUFFER, self._table_buffer)
        GL.glBufferData(GL.GL_TEXTURE_BUFFER, self._table.nbytes, self._table, GL.GL_STREAM_DRAW)
        return True

    def _draw_scene(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int, light: Floats) -> None:
        GL = self._gl
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._target)
        GL.glViewport(0, 0, self._width, self._height)
        GL.glClearColor(0.0, 0.0, 0.0, 1.0)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        GL.glUseProgram(self._program)
        projection = camera_matrix(model, data, camera, self._height, self._width)
        GL.glUniformMatrix4fv(self._at["projection"], 1, GL.GL_TRUE, projection)
        GL.glUniformMatrix4fv(self._at["light"], 1, GL.GL_TRUE, light)
        GL.glUniform3fv(self._at["eye"], 1, data.cam_xpos[camera].astype(np.float32))
        self._set_lights(model, data, data.cam_xmat[camera].reshape(3, 3)[:, 2])
        GL.glFrontFace(GL.GL_CW)  # frames are drawn upside down
        GL.glDrawElements(GL.GL_TRIANGLES, self._list.indices.size, GL.GL_UNSIGNED_INT, None)

    def _set_lights(self, model: mujoco.MjModel, data: mujoco.MjData, back: NDArray[np.floating]) -> None:
        """Tell the shader of the lights; ``back`` (3,) is the way from what is seen to the camera, the headlight."""
        GL, head, chosen = self._gl, model.vis.headlight, self._lights
        ambient = head.ambient + model.light_ambient[chosen].sum(axis=0)
        towards = np.vstack([back, -data.light_xdir[chosen]]).astype(np.float32)
        diffuse = np.vstack([head.diffuse, model.light_diffuse[chosen]]).astype(np.float32)
        specular = np.vstack([head.specular, model.light_specular[chosen]]).astype(np.float32)
        GL.glUniform3fv(self._at["ambient"], 1, ambient.astype(np.float32))
        GL.glUniform3fv(self._at["light_to"], len(towards), towards)
        GL.glUniform3fv(self._at["light_diffuse"], len(towards), diffuse)
        GL.glUniform3fv(self._at["light_specular"], len(towards), specular)

    def _draw_discs(self, count: int) -> None:
        GL = self._gl
        start = ctypes.c_void_p(4 * self._first_disc)
        GL.glEnable(GL.GL_BLEND)
        GL.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
        GL.glDepthMask(GL.GL_FALSE)
        GL.glDrawElements(GL.GL_TRIANGLES, count * self._disc_size, GL.GL_UNSIGNED_INT, start)
        GL.glDepthMask(GL.GL_TRUE)
        GL.glDisable(GL.GL_BLEND)

    def _read(self) -> Image:
        GL = self._gl
        size = (self._width, self._height)
        if self._result != self._target:
            GL.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._target)
            GL.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._result)
            GL.glBlitFramebuffer(0, 0, *size, 0, 0, *size, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._result)
        GL.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        image = np.empty((self._height, self._width, 3), dtype=np.uint8)
        GL.glReadPixels(0, 0, *size, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, image)
        return image

    def free(self) -> None:
        """Delete all GL objects; the context they were made in must be current."""
        self._resources.free()
