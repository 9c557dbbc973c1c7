"""Draw a `DrawList` with OpenGL: one shadow map per state, one draw call per camera.

The light is MuJoCo's: a headlight with ambience, directional lights, Blinn's highlights, textures that modulate all of
it. Shadows are those of the first directional light that casts them, with soft edges.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.gl.drawlist import LAYER_SIZE, ROWS, VERTEX, DrawList, Floats, disc
from lerobot_memobench.sim.gl.resources import Resources, frame_calls
from lerobot_memobench.sim.gl.shaders import (
    ATTRIBUTES,
    TEXTURE_UNITS,
    frame_block,
    geom_program,
    scene_program,
    shadow_program,
)

Image = NDArray[np.uint8]
HIGHLIGHTS = 16
"""Highlights that fit into a frame."""
DISC_HALF_HEIGHT = 0.001


@dataclass(frozen=True)
class Highlight:
    """A translucent disc drawn over the scene: the prompt's way of marking a place."""

    position: tuple[float, float, float]
    radius: float
    rgba: tuple[float, float, float, float] = (1.0, 0.85, 0.1, 0.55)


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

        self._gl, self._call = GL, frame_calls()
        self._list, self._width, self._height = draw_list, width, height
        lights = [
            i
            for i in range(model.nlight)
            if model.light_active[i] and model.light_type[i] == mujoco.mjtLightType.mjLIGHT_DIRECTIONAL.value
        ]
        casting = [i for i in lights if model.light_castshadow[i]]
        casters = draw_list.still.size + draw_list.moving.size
        caster = casting[0] if casting and shadow_size and casters else None
        self._view = View(model, lights, caster, height, width)
        self._resources = Resources(GL, self._call, width, height)
        self._sent: bytes | None = None
        self._make_vertices()
        self._make_tables()
        self._make_textures()
        self._make_targets(samples)
        self._shadows: ShadowMap | None = None
        if caster is not None:
            first = draw_list.indices.size
            self._shadows = ShadowMap(GL, self._call, self._resources, draw_list, shadow_size, first)
        # The headlight goes before the other lights.
        shadowed = None if caster is None else 1 + lights.index(caster)
        self._program = self._resources.program(scene_program(GL, 1 + len(lights), shadowed))
        self._geom_program: int | None = None

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

    def _make_tables(self) -> None:
        """Make what tells the shaders of each geom, a texture, and of the view, a block; `draw` fills both."""
        GL = self._gl
        self._table = np.zeros((len(self._list.geoms) + HIGHLIGHTS, ROWS, 4), dtype=np.float32)
        self._table_buffer = self._resources.buffer(GL.GL_TEXTURE_BUFFER, self._table, GL.GL_STREAM_DRAW)
        self._resources.texture(TEXTURE_UNITS["geoms"], GL.GL_TEXTURE_BUFFER)
        GL.glTexBuffer(GL.GL_TEXTURE_BUFFER, GL.GL_RGBA32F, self._table_buffer)
        self._view_buffer = self._resources.buffer(GL.GL_UNIFORM_BUFFER, self._view.block, GL.GL_STREAM_DRAW)

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
        self._target = self._plain_target(samples)
        size = (self._width, self._height)
        self._result = self._target
        if samples:
            self._result = make.framebuffer()
            make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, 0, size)
            make.check_framebuffer()

    def _plain_target(self, samples: int = 0) -> int:
        """Make a framebuffer of colours and depths."""
        GL, make, size = self._gl, self._resources, (self._width, self._height)
        target = make.framebuffer()
        make.renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, samples, size)
        make.renderbuffer(GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT, samples, size)
        make.check_framebuffer()
        return target

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
        count = len(highlights)
        if count > HIGHLIGHTS:
            raise MemobenchError(f"there are {count} highlights in a frame; at most {HIGHLIGHTS} can be drawn")
        self._enter()
        self._send_view(model, data, camera)
        if self._send_geoms(model, data, highlights) and self._shadows is not None:
            self._shadows.draw(self._table, self._view.block["light"])
        self._draw_scene(self._target, self._program)
        if count:
            self._draw_discs(count)
        if self._result != self._target:
            self._resolve()
        return self._read(self._result)

    def draw_geoms(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> NDArray[np.int64]:
        """Return the id of the geom that each pixel of `draw` shows, (height, width), -1 for none, highlights left out.

        One sample per pixel, in its middle, whatever the quality of pictures.
        """
        self._enter()
        if self._geom_program is None:
            self._geom_target = self._plain_target()
            self._geom_program = self._resources.program(geom_program(self._gl))
        self._send_view(model, data, camera)
        if self._send_geoms(model, data, ()):
            self._sent = None  # the shadows are still of another state
        self._draw_scene(self._geom_target, self._geom_program)
        codes = self._read(self._geom_target).astype(np.int64)
        rows = codes[..., 0] + 256 * codes[..., 1] - 1
        return np.where(rows >= 0, self._list.geoms[rows], -1)

    def _enter(self) -> None:
        """Set the context's state, which other renderers share."""
        GL, call = self._gl, self._call
        call.glBindVertexArray(self._array)
        self._resources.bind_textures()
        call.glEnable(GL.GL_DEPTH_TEST)
        call.glEnable(GL.GL_CULL_FACE)
        call.glDisable(GL.GL_BLEND)
        call.glDepthMask(GL.GL_TRUE)

    def _send_view(self, model: mujoco.MjModel, data: mujoco.MjData, camera: str) -> None:
        GL, call = self._gl, self._call
        block = self._view.look(model, data, model.camera(camera).id)
        call.glBindBufferBase(GL.GL_UNIFORM_BUFFER, 0, self._view_buffer)  # 0 is where a program's first block reads
        call.glBufferData(GL.GL_UNIFORM_BUFFER, block.nbytes, block.ctypes.data, GL.GL_STREAM_DRAW)

    def _send_geoms(self, model: mujoco.MjModel, data: mujoco.MjData, highlights: Sequence[Highlight]) -> bool:
        """Bring the table up to date; return whether it had to be, False where the last frame was of the same state."""
        GL, call = self._gl, self._call
        rows = len(self._list.geoms)
        self._list.fill(self._table[:rows], model, data)
        for row, mark in zip(self._table[rows:], highlights, strict=False):
            row[:3] = np.diag([mark.radius, mark.radius, DISC_HALF_HEIGHT]) @ np.eye(3, 4)
            row[:3, 3] = mark.position
            row[3], row[4] = mark.rgba, (0.0, 1.0, 0.3, 0.0)
        state = self._table.tobytes()
        if state == self._sent:
            return False
        self._sent = state
        call.glBindBuffer(GL.GL_TEXTURE_BUFFER, self._table_buffer)
        call.glBufferData(GL.GL_TEXTURE_BUFFER, self._table.nbytes, self._table.ctypes.data, GL.GL_STREAM_DRAW)
        return True

    def _draw_scene(self, target: int, program: int) -> None:
        GL, call = self._gl, self._call
        call.glBindFramebuffer(GL.GL_FRAMEBUFFER, target)
        call.glViewport(0, 0, self._width, self._height)
        call.glClearColor(0.0, 0.0, 0.0, 1.0)
        call.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        call.glUseProgram(program)
        call.glFrontFace(GL.GL_CW)  # frames are drawn upside down
        call.glDrawElements(GL.GL_TRIANGLES, self._list.indices.size, GL.GL_UNSIGNED_INT, 0)

    def _draw_discs(self, count: int) -> None:
        GL, call = self._gl, self._call
        call.glEnable(GL.GL_BLEND)
        call.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
        call.glDepthMask(GL.GL_FALSE)
        call.glDrawElements(GL.GL_TRIANGLES, count * self._disc_size, GL.GL_UNSIGNED_INT, 4 * self._first_disc)
        call.glDepthMask(GL.GL_TRUE)
        call.glDisable(GL.GL_BLEND)

    def _resolve(self) -> None:
        """Make one sample of a pixel's several."""
        GL, call, size = self._gl, self._call, (self._width, self._height)
        call.glBindFramebuffer(GL.GL_READ_FRAMEBUFFER, self._target)
        call.glBindFramebuffer(GL.GL_DRAW_FRAMEBUFFER, self._result)
        call.glBlitFramebuffer(0, 0, *size, 0, 0, *size, GL.GL_COLOR_BUFFER_BIT, GL.GL_NEAREST)

    def _read(self, source: int) -> Image:
        GL, call = self._gl, self._call
        size = (self._width, self._height)
        call.glBindFramebuffer(GL.GL_FRAMEBUFFER, source)
        call.glPixelStorei(GL.GL_PACK_ALIGNMENT, 1)
        image = np.empty((self._height, self._width, 3), dtype=np.uint8)
        call.glReadPixels(0, 0, *size, GL.GL_RGB, GL.GL_UNSIGNED_BYTE, image.ctypes.data)
        if error := call.glGetError():
            raise MemobenchError(
                f"the GL driver failed to draw a frame (error {error:#06x}); try render=fast or another MUJOCO_GL, and "
                "see `memobench doctor`"
            )
        return image

    def free(self) -> None:
        """Delete all GL objects; the context they were made in must be current."""
        self._resources.free()


# --- the view of a camera and of a light: matrices to clip space ---


class View:
    """What the shaders are told of a frame, in their layout (`shaders.frame_block`).

    Args:
        model: where lights and clipping planes are read from.
        lights: ids of the directional lights that shine.
        caster: which of them casts shadows, None for none.
        height, width: size of a frame, pixels.
    """

    def __init__(self, model: mujoco.MjModel, lights: list[int], caster: int | None, height: int, width: int) -> None:
        self._lights, self._caster, self._height, self._width = lights, caster, height, width
        head = model.vis.headlight  # goes before the other lights
        self.block: NDArray[Any] = np.zeros((), dtype=frame_block(1 + len(lights)))
        self.block["light"] = np.eye(4)
        self.block["ambient"][:3] = (head.ambient + model.light_ambient[lights].sum(axis=0)).astype(np.float32)
        self.block["light_diffuse"][:, :3] = np.vstack([head.diffuse, model.light_diffuse[lights]])
        self.block["light_specular"][:, :3] = np.vstack([head.specular, model.light_specular[lights]])
        self._shining: bytes | None = None

    def look(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int) -> NDArray[Any]:
        """Return the block for a camera's view of a state; it is overwritten by the next call."""
        block = self.block
        # The shaders keep matrices by columns.
        block["projection"] = camera_matrix(model, data, camera, self._height, self._width).T
        block["eye"][:3] = data.cam_xpos[camera]
        directions = data.light_xdir[self._lights]
        block["light_to"][0, :3] = data.cam_xmat[camera].reshape(3, 3)[:, 2]  # a headlight shines from the camera
        block["light_to"][1:, :3] = -directions
        shining = directions.tobytes()
        if self._caster is not None and shining != self._shining:  # lamps hang still
            self._shining = shining
            block["light"] = light_matrix(model, data, self._caster).T
        return block


def camera_matrix(model: mujoco.MjModel, data: mujoco.MjData, camera: int, height: int, width: int) -> Floats:
    """Return the matrix (4, 4) from the world to a camera's clip space, upside down.

    So the first row that is read back is the top one; faces turn around with it.

    Args:
        model, data: the state to show.
        camera: its id.
        height, width: size of a frame, pixels.
    """
    eye, frame = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    near, far = (float(p * model.stat.extent) for p in (model.vis.map.znear, model.vis.map.zfar))
    slope = 1.0 / np.tan(np.radians(float(model.cam_fovy[camera])) / 2)
    projection = np.zeros((4, 4))
    projection[0, 0] = slope * height / width
    projection[1, 1] = -slope
    projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
    projection[3, 2] = -1.0
    view = np.eye(4)
    view[:3, :3] = frame.T
    view[:3, 3] = -frame.T @ eye
    return (projection @ view).astype(np.float32)


def light_matrix(model: mujoco.MjModel, data: mujoco.MjData, light: int) -> Floats:
    """Return the matrix (4, 4) from the world to the clip space of a directional light."""
    forward = data.light_xdir[light]
    if not forward.any():  # nothing was simulated yet
        forward = model.light_dir[light]
    side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.99 else [0.0, 1.0, 0.0])
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    half = float(model.vis.map.shadowclip * model.stat.extent)
    centre = model.stat.center
    matrix = np.zeros((4, 4), dtype=np.float32)
    for row, axis in enumerate((side, up, forward)):
        reach = half if row < 2 else 2.0 * half
        matrix[row, :3] = axis / reach
        matrix[row, 3] = -axis @ centre / reach
    matrix[3, 3] = 1.0
    return matrix


# --- shadows: depths as the light sees them; only what has moved is drawn anew ---


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
        # The nearest depth of a texel is the same in any order of drawing.
        self._draw(self._first + self._list.still.size, self._list.moving.size)
        call.glDisable(GL.GL_POLYGON_OFFSET_FILL)

    def _draw(self, first: int, count: int) -> None:
        GL = self._gl
        self._call.glDrawElements(GL.GL_TRIANGLES, count, GL.GL_UNSIGNED_INT, 4 * first)
