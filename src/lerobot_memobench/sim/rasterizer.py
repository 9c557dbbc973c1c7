"""Draw a `DrawList` with OpenGL: one shadow map per state, one draw call per camera.

The light is MuJoCo's: a headlight with ambience, directional lights, Blinn's highlights, textures that modulate all of
it. Shadows are those of the first directional light that casts them, with soft edges.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.drawlist import LAYER_SIZE, ROWS, VERTEX, DrawList, Floats, disc

Image = NDArray[np.uint8]

HIGHLIGHTS = 16
"""Translucent discs that fit into a frame."""

_VERTEX_SHADER = """#version 140
const int LIGHTS = %(lights)d;
const int CASTER = %(caster)d;
uniform samplerBuffer geoms;
uniform mat4 projection;
uniform mat4 light;
uniform vec3 eye;
uniform vec3 ambient;
uniform vec3 light_to[LIGHTS];
uniform vec3 light_diffuse[LIGHTS];
uniform vec3 light_specular[LIGHTS];
in vec3 position;
in vec3 normal;
in vec2 uv;
in float geom;
out vec3 texel;
out vec4 steady;
out vec3 shadowed;
out vec3 shade;
void main() {
    int row = 5 * int(geom + 0.5);
    vec4 x = texelFetch(geoms, row), y = texelFetch(geoms, row + 1), z = texelFetch(geoms, row + 2);
    vec4 colour = texelFetch(geoms, row + 3), material = texelFetch(geoms, row + 4);
    vec4 local = vec4(position, 1.0);
    vec3 world = vec3(dot(x, local), dot(y, local), dot(z, local));
    vec3 n = normalize(vec3(dot(x.xyz, normal), dot(y.xyz, normal), dot(z.xyz, normal)));
    vec3 v = normalize(eye - world);
    steady = vec4((ambient + material.z) * colour.rgb, colour.a);
    shadowed = vec3(0.0);
    for (int i = 0; i < LIGHTS; i++) {
        float facing = dot(n, light_to[i]);
        if (facing > 0.0) {
            float glint = pow(max(dot(n, normalize(light_to[i] + v)), 0.0), max(material.y, 1.0));
            vec3 part = facing * light_diffuse[i] * colour.rgb + glint * material.x * light_specular[i];
            if (i == CASTER) shadowed += part; else steady.rgb += part;
        }
    }
    texel = vec3(uv, material.w);
    shade = (light * vec4(world, 1.0)).xyz * 0.5 + 0.5;
    gl_Position = projection * vec4(world, 1.0);
}
"""

_FRAGMENT_SHADER = """#version 140
uniform sampler2DArray textures;
uniform sampler2DShadow shadows;
in vec3 texel;
in vec4 steady;
in vec3 shadowed;
in vec3 shade;
out vec4 pixel;
void main() {
    vec3 paint = texture(textures, texel).rgb;
    pixel = vec4((steady.rgb + %(lit)s * shadowed) * paint, steady.a);
}
"""

_SHADOW_VERTEX_SHADER = """#version 140
uniform samplerBuffer geoms;
uniform mat4 light;
in vec3 position;
in float geom;
void main() {
    int row = 5 * int(geom + 0.5);
    vec4 local = vec4(position, 1.0);
    vec3 world = vec3(
        dot(texelFetch(geoms, row), local),
        dot(texelFetch(geoms, row + 1), local),
        dot(texelFetch(geoms, row + 2), local));
    gl_Position = light * vec4(world, 1.0);
}
"""

_SHADOW_FRAGMENT_SHADER = """#version 140
void main() {}
"""

_ATTRIBUTES = ("position", "normal", "uv", "geom")


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
        self._caster = casting[0] if casting and shadow_size and draw_list.casting else None
        self._buffers: list[int] = []
        self._textures: list[int] = []
        self._renderbuffers: list[int] = []
        self._frames: list[int] = []
        self._programs: list[int] = []
        self._sent: bytes | None = None
        self._upload()
        self._make_targets(samples)
        if self._caster is not None:
            self._make_shadow_map(shadow_size)
        self._make_programs()

    # --- set up ---------------------------------------------------------------------------------------------

    def _upload(self) -> None:
        GL = self._gl
        # Behind the scene's own vertices: one disc per highlight, each with its row of the table.
        positions, normals, uv, triangles = disc()
        rows = len(self._list.geoms)
        discs = np.zeros((HIGHLIGHTS, len(positions)), dtype=VERTEX)
        discs["position"], discs["normal"], discs["uv"] = positions, normals, uv
        discs["geom"] = rows + np.arange(HIGHLIGHTS)[:, None]
        start = len(self._list.vertices)
        steps = start + len(positions) * np.arange(HIGHLIGHTS)[:, None]
        disc_indices = (triangles.reshape(1, -1) + steps).astype(np.uint32)
        self._disc_size = int(triangles.size)
        vertices = np.concatenate([self._list.vertices, discs.ravel()])
        indices = np.concatenate([self._list.indices, disc_indices.ravel()])

        self._array = int(GL.glGenVertexArrays(1))
        GL.glBindVertexArray(self._array)
        self._buffer(GL.GL_ARRAY_BUFFER, vertices.view(np.uint8), GL.GL_STATIC_DRAW)
        self._buffer(GL.GL_ELEMENT_ARRAY_BUFFER, indices, GL.GL_STATIC_DRAW)
        for location, name in enumerate(_ATTRIBUTES):
            kind, offset = VERTEX.fields[name][:2]  # type: ignore[index]
            count = int(np.prod(kind.shape)) if kind.shape else 1
            GL.glEnableVertexAttribArray(location)
            GL.glVertexAttribPointer(
                location, count, GL.GL_FLOAT, GL.GL_FALSE, VERTEX.itemsize, ctypes.c_void_p(offset)
            )
        self._table = np.zeros((rows + HIGHLIGHTS, ROWS, 4), dtype=np.float32)
        self._table_buffer = self._buffer(GL.GL_TEXTURE_BUFFER, self._table, GL.GL_STREAM_DRAW)
        table_texture = self._texture(0, GL.GL_TEXTURE_BUFFER)
        GL.glTexBuffer(GL.GL_TEXTURE_BUFFER, GL.GL_RGBA32F, self._table_buffer)
        del table_texture

        self._texture(1, GL.GL_TEXTURE_2D_ARRAY)
        GL.glPixelStorei(GL.GL_UNPACK_ALIGNMENT, 1)
        layers = np.ascontiguousarray(self._list.layers)
        GL.glTexImage3D(
            GL.GL_TEXTURE_2D_ARRAY, 0, GL.GL_RGB8, LAYER_SIZE, LAYER_SIZE, len(layers), 0, GL.GL_RGB,
            GL.GL_UNSIGNED_BYTE, layers,
        )  # fmt: skip
        GL.glGenerateMipmap(GL.GL_TEXTURE_2D_ARRAY)
        self._sample(GL.GL_TEXTURE_2D_ARRAY, GL.GL_LINEAR_MIPMAP_LINEAR, GL.GL_REPEAT)

    def _buffer(self, target: Any, content: NDArray[Any], usage: Any) -> int:
        GL = self._gl
        name = int(GL.glGenBuffers(1))
        self._buffers.append(name)
        GL.glBindBuffer(target, name)
        GL.glBufferData(target, content.nbytes, np.ascontiguousarray(content), usage)
        return name

    def _texture(self, unit: int, target: Any) -> int:
        """Make a texture and leave it bound to its unit for good: nobody else draws in this context's state."""
        GL = self._gl
        name = int(GL.glGenTextures(1))
        self._textures.append(name)
        self._units = [*getattr(self, "_units", []), (unit, target, name)]
        GL.glActiveTexture(GL.GL_TEXTURE0 + unit)
        GL.glBindTexture(target, name)
        return name

    def _sample(self, target: Any, minify: Any, wrap: Any) -> None:
        GL = self._gl
        GL.glTexParameteri(target, GL.GL_TEXTURE_MIN_FILTER, minify)
        GL.glTexParameteri(target, GL.GL_TEXTURE_MAG_FILTER, GL.GL_LINEAR)
        GL.glTexParameteri(target, GL.GL_TEXTURE_WRAP_S, wrap)
        GL.glTexParameteri(target, GL.GL_TEXTURE_WRAP_T, wrap)

    def _frame(self) -> int:
        name = int(self._gl.glGenFramebuffers(1))
        self._frames.append(name)
        self._gl.glBindFramebuffer(self._gl.GL_FRAMEBUFFER, name)
        return name

    def _renderbuffer(self, kind: Any, attachment: Any, samples: int) -> None:
        GL = self._gl
        name = int(GL.glGenRenderbuffers(1))
        self._renderbuffers.append(name)
        GL.glBindRenderbuffer(GL.GL_RENDERBUFFER, name)
        GL.glRenderbufferStorageMultisample(GL.GL_RENDERBUFFER, samples, kind, self._width, self._height)
        GL.glFramebufferRenderbuffer(GL.GL_FRAMEBUFFER, attachment, GL.GL_RENDERBUFFER, name)

    def _complete(self) -> None:
        GL = self._gl
        status = GL.glCheckFramebufferStatus(GL.GL_FRAMEBUFFER)
        if status != GL.GL_FRAMEBUFFER_COMPLETE:
            raise MemobenchError(
                f"the GL driver cannot draw {self._width}×{self._height} frames (framebuffer status {status}); try "
                "render=fast or another MUJOCO_GL, and see `memobench doctor`"
            )

    def _make_targets(self, samples: int) -> None:
        GL = self._gl
        samples = min(samples, int(GL.glGetIntegerv(GL.GL_MAX_SAMPLES)))
        self._target = self._frame()
        self._renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, samples)
        self._renderbuffer(GL.GL_DEPTH_COMPONENT24, GL.GL_DEPTH_ATTACHMENT, samples)
        self._complete()
        self._result = self._target
        if samples:
            self._result = self._frame()
            self._renderbuffer(GL.GL_RGBA8, GL.GL_COLOR_ATTACHMENT0, 0)
            self._complete()

    def _make_shadow_map(self, size: int) -> None:
        GL = self._gl
        self._shadow_size = size
        self._shadow_frame = self._frame()
        texture = self._texture(2, GL.GL_TEXTURE_2D)
        GL.glTexImage2D(
            GL.GL_TEXTURE_2D, 0, GL.GL_DEPTH_COMPONENT16, size, size, 0, GL.GL_DEPTH_COMPONENT,
            GL.GL_UNSIGNED_SHORT, None,
        )  # fmt: skip
        self._sample(GL.GL_TEXTURE_2D, GL.GL_LINEAR, GL.GL_CLAMP_TO_BORDER)
        GL.glTexParameterfv(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_BORDER_COLOR, np.ones(4, dtype=np.float32))
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_MODE, GL.GL_COMPARE_REF_TO_TEXTURE)
        GL.glTexParameteri(GL.GL_TEXTURE_2D, GL.GL_TEXTURE_COMPARE_FUNC, GL.GL_LEQUAL)
        GL.glFramebufferTexture2D(GL.GL_FRAMEBUFFER, GL.GL_DEPTH_ATTACHMENT, GL.GL_TEXTURE_2D, texture, 0)
        GL.glDrawBuffer(GL.GL_NONE)
        GL.glReadBuffer(GL.GL_NONE)
        self._complete()

    def _make_programs(self) -> None:
        GL = self._gl
        lights = 1 + len(self._lights)  # the headlight goes first
        caster = -1 if self._caster is None else 1 + self._lights.index(self._caster)
        lit = "1.0" if self._caster is None else "texture(shadows, shade)"
        vertex = _VERTEX_SHADER % {"lights": lights, "caster": caster}
        self._program = self._compile(vertex, _FRAGMENT_SHADER % {"lit": lit})
        for unit, name in enumerate(("geoms", "textures", "shadows")):
            GL.glUniform1i(GL.glGetUniformLocation(self._program, name), unit)
        names = ("projection", "light", "eye", "ambient", "light_to", "light_diffuse", "light_specular")
        self._at = {name: GL.glGetUniformLocation(self._program, name) for name in names}
        if self._caster is not None:
            self._shadow_program = self._compile(_SHADOW_VERTEX_SHADER, _SHADOW_FRAGMENT_SHADER)
            GL.glUniform1i(GL.glGetUniformLocation(self._shadow_program, "geoms"), 0)
            self._shadow_light = GL.glGetUniformLocation(self._shadow_program, "light")

    def _compile(self, vertex: str, fragment: str) -> int:
        GL = self._gl
        program = int(GL.glCreateProgram())
        self._programs.append(program)
        for kind, source in ((GL.GL_VERTEX_SHADER, vertex), (GL.GL_FRAGMENT_SHADER, fragment)):
            shader = GL.glCreateShader(kind)
            GL.glShaderSource(shader, source)
            GL.glCompileShader(shader)
            if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
                raise self._refused(GL.glGetShaderInfoLog(shader))
            GL.glAttachShader(program, shader)
            GL.glDeleteShader(shader)  # goes with the program
        for location, name in enumerate(_ATTRIBUTES):
            GL.glBindAttribLocation(program, location, name)
        GL.glLinkProgram(program)
        if not GL.glGetProgramiv(program, GL.GL_LINK_STATUS):
            raise self._refused(GL.glGetProgramInfoLog(program))
        GL.glUseProgram(program)
        return program

    def _refused(self, log: bytes | str) -> MemobenchError:
        text = log.decode(errors="replace") if isinstance(log, bytes) else log
        version = self._gl.glGetString(self._gl.GL_VERSION)
        return MemobenchError(
            f"the GL driver ({version.decode() if version else 'unknown'}) refused a shader: "
            f"{' '.join(text.split())}; OpenGL 3.1 is needed, try MUJOCO_GL=osmesa"
        )

    # --- draw -----------------------------------------------------------------------------------------------

    def draw(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: int,
        discs: Sequence[tuple[NDArray[np.floating], float, float, Sequence[float]]] = (),
    ) -> Image:
        """Return what a camera sees, (height, width, 3) uint8, first row on top.

        Args:
            model: an instance of the model that the draw list was made of.
            data: the state to show.
            camera: its id.
            discs: position (3,), radius, half height [m] and rgba of each translucent disc, drawn in this order.
        """
        GL = self._gl
        if len(discs) > HIGHLIGHTS:
            raise MemobenchError(f"there are {len(discs)} highlights in a frame; at most {HIGHLIGHTS} can be drawn")
        GL.glBindVertexArray(self._array)
        for unit, target, name in self._units:
            GL.glActiveTexture(GL.GL_TEXTURE0 + unit)
            GL.glBindTexture(target, name)
        GL.glEnable(GL.GL_DEPTH_TEST)
        GL.glEnable(GL.GL_CULL_FACE)
        GL.glDisable(GL.GL_BLEND)
        GL.glDepthMask(GL.GL_TRUE)
        light = self._light_matrix(model, data)
        self._send(model, data, discs, light)

        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._target)
        GL.glViewport(0, 0, self._width, self._height)
        GL.glClearColor(0.0, 0.0, 0.0, 1.0)
        GL.glClear(GL.GL_COLOR_BUFFER_BIT | GL.GL_DEPTH_BUFFER_BIT)
        GL.glUseProgram(self._program)
        self._set_uniforms(model, data, camera, light)
        # Frames are drawn upside down, so that the first row read back is the top one; that turns faces around.
        GL.glFrontFace(GL.GL_CW)
        count = self._list.indices.size
        GL.glDrawElements(GL.GL_TRIANGLES, count, GL.GL_UNSIGNED_INT, None)
        if discs:
            GL.glEnable(GL.GL_BLEND)
            GL.glBlendFunc(GL.GL_SRC_ALPHA, GL.GL_ONE_MINUS_SRC_ALPHA)
            GL.glDepthMask(GL.GL_FALSE)
            GL.glDrawElements(
                GL.GL_TRIANGLES, len(discs) * self._disc_size, GL.GL_UNSIGNED_INT, ctypes.c_void_p(4 * count)
            )
            GL.glDepthMask(GL.GL_TRUE)
            GL.glDisable(GL.GL_BLEND)
        return self._read()

    def _send(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        discs: Sequence[tuple[NDArray[np.floating], float, float, Sequence[float]]],
        light: Floats,
    ) -> None:
        """Bring table and shadow map up to date, unless the last frame was of the same state."""
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
            return
        self._sent = state
        GL.glBindBuffer(GL.GL_TEXTURE_BUFFER, self._table_buffer)
        GL.glBufferData(GL.GL_TEXTURE_BUFFER, self._table.nbytes, self._table, GL.GL_STREAM_DRAW)
        if self._caster is None:
            return
        GL.glBindFramebuffer(GL.GL_FRAMEBUFFER, self._shadow_frame)
        GL.glViewport(0, 0, self._shadow_size, self._shadow_size)
        GL.glClear(GL.GL_DEPTH_BUFFER_BIT)
        GL.glUseProgram(self._shadow_program)
        GL.glUniformMatrix4fv(self._shadow_light, 1, GL.GL_TRUE, light)
        GL.glFrontFace(GL.GL_CCW)
        # Pushed away from the light by more than a texel's slope, or surfaces would speckle themselves.
        GL.glEnable(GL.GL_POLYGON_OFFSET_FILL)
        GL.glPolygonOffset(2.0, 4.0)
        GL.glDrawElements(GL.GL_TRIANGLES, self._list.casting, GL.GL_UNSIGNED_INT, None)
        GL.glDisable(GL.GL_POLYGON_OFFSET_FILL)

    def _light_matrix(self, model: mujoco.MjModel, data: mujoco.MjData) -> Floats:
        """Return the matrix (4, 4) from the world to the clip space of the light that casts shadows."""
        if self._caster is None:
            return np.eye(4, dtype=np.float32)
        forward = data.light_xdir[self._caster]
        if not forward.any():  # nothing was simulated yet
            forward = model.light_dir[self._caster]
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

    def _set_uniforms(self, model: mujoco.MjModel, data: mujoco.MjData, camera: int, light: Floats) -> None:
        GL = self._gl
        eye, frame = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
        near, far = (float(p * model.stat.extent) for p in (model.vis.map.znear, model.vis.map.zfar))
        slope = 1.0 / np.tan(np.radians(float(model.cam_fovy[camera])) / 2)
        projection = np.zeros((4, 4))
        projection[0, 0] = slope * self._height / self._width
        projection[1, 1] = -slope  # upside down, see draw
        projection[2, 2:] = (far + near) / (near - far), 2 * far * near / (near - far)
        projection[3, 2] = -1.0
        view = np.eye(4)
        view[:3, :3] = frame.T
        view[:3, 3] = -frame.T @ eye
        GL.glUniformMatrix4fv(self._at["projection"], 1, GL.GL_TRUE, (projection @ view).astype(np.float32))
        GL.glUniformMatrix4fv(self._at["light"], 1, GL.GL_TRUE, light)
        GL.glUniform3fv(self._at["eye"], 1, eye.astype(np.float32))
        head = model.vis.headlight
        chosen = self._lights
        ambient = head.ambient + model.light_ambient[chosen].sum(axis=0)
        GL.glUniform3fv(self._at["ambient"], 1, ambient.astype(np.float32))
        towards = np.vstack([frame[:, 2], -data.light_xdir[chosen]]).astype(np.float32)
        diffuse = np.vstack([head.diffuse, model.light_diffuse[chosen]]).astype(np.float32)
        specular = np.vstack([head.specular, model.light_specular[chosen]]).astype(np.float32)
        GL.glUniform3fv(self._at["light_to"], len(towards), towards)
        GL.glUniform3fv(self._at["light_diffuse"], len(towards), diffuse)
        GL.glUniform3fv(self._at["light_specular"], len(towards), specular)

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
        GL = self._gl
        for program in self._programs:
            GL.glDeleteProgram(program)
        GL.glDeleteVertexArrays(1, [self._array])
        for delete, names in (
            (GL.glDeleteBuffers, self._buffers),
            (GL.glDeleteTextures, self._textures),
            (GL.glDeleteRenderbuffers, self._renderbuffers),
            (GL.glDeleteFramebuffers, self._frames),
        ):
            if names:
                delete(len(names), names)
                names.clear()
        self._programs.clear()
