"""The GLSL programs: a scene in MuJoCo's light, and the shadow map of one light."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_memobench.errors import MemobenchError

_VERTEX_SHADER = """#version 140
const int LIGHTS = %(lights)d;
const int CASTER = %(caster)d;
uniform samplerBuffer rows;
layout(std140) uniform Frame {
    mat4 light;
    mat4 projection;
    vec4 eye;
    vec4 ambient;
    vec4 light_to[LIGHTS];
    vec4 light_diffuse[LIGHTS];
    vec4 light_specular[LIGHTS];
};
in vec3 position;
in vec3 normal;
in vec2 uv;
in float row;
out vec3 texel;
out vec4 steady;
out vec3 shadowed;
out vec3 shade;
void main() {
    int first = 5 * int(row + 0.5);
    vec4 x = texelFetch(rows, first), y = texelFetch(rows, first + 1), z = texelFetch(rows, first + 2);
    vec4 colour = texelFetch(rows, first + 3), material = texelFetch(rows, first + 4);
    vec4 local = vec4(position, 1.0);
    vec3 world = vec3(dot(x, local), dot(y, local), dot(z, local));
    vec3 n = normalize(vec3(dot(x.xyz, normal), dot(y.xyz, normal), dot(z.xyz, normal)));
    vec3 v = normalize(eye.xyz - world);
    steady = vec4((ambient.xyz + material.z) * colour.rgb, colour.a);
    shadowed = vec3(0.0);
    for (int i = 0; i < LIGHTS; i++) {
        float facing = dot(n, light_to[i].xyz);
        if (facing > 0.0) {
            float glint = pow(max(dot(n, normalize(light_to[i].xyz + v)), 0.0), max(material.y, 1.0));
            vec3 part = facing * light_diffuse[i].xyz * colour.rgb + glint * material.x * light_specular[i].xyz;
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
uniform samplerBuffer rows;
layout(std140) uniform Frame { mat4 light; };
in vec3 position;
in float row;
void main() {
    int first = 5 * int(row + 0.5);
    vec4 local = vec4(position, 1.0);
    vec4 x = texelFetch(rows, first), y = texelFetch(rows, first + 1), z = texelFetch(rows, first + 2);
    gl_Position = light * vec4(dot(x, local), dot(y, local), dot(z, local), 1.0);
}
"""

_SHADOW_FRAGMENT_SHADER = """#version 140
void main() {}
"""

ATTRIBUTES = ("position", "normal", "uv", "row")
"""What a vertex has, by location."""

TEXTURE_UNITS = {"rows": 0, "textures": 1, "shadows": 2}
"""Unit of each sampler: the table of rows, their textures, the shadow map."""


def frame_block(lights: int) -> np.dtype[np.void]:
    """Return the layout of the block ``Frame``, which both programs read: matrices by columns, vectors of four.

    Args:
        lights: how many there are.
    """
    light = ("<f4", (lights, 4))
    matrix, vector = ("<f4", (4, 4)), ("<f4", 4)
    return np.dtype(
        [
            ("light", *matrix),
            ("projection", *matrix),
            ("eye", *vector),
            ("ambient", *vector),
            ("light_to", *light),
            ("light_diffuse", *light),
            ("light_specular", *light),
        ]
    )


def scene_program(GL: Any, lights: int, caster: int) -> int:
    """Compile the program that draws a scene and leave it in use.

    Args:
        GL: PyOpenGL's module; a context is current.
        lights: how many there are.
        caster: which of them casts shadows, −1 for none.
    """
    vertex = _VERTEX_SHADER % {"lights": lights, "caster": caster}
    fragment = _FRAGMENT_SHADER % {"lit": "1.0" if caster < 0 else "texture(shadows, shade)"}
    return _program(GL, vertex, fragment)


def shadow_program(GL: Any) -> int:
    """Compile the program that draws depths as a light sees them, and leave it in use."""
    return _program(GL, _SHADOW_VERTEX_SHADER, _SHADOW_FRAGMENT_SHADER)


def _program(GL: Any, vertex: str, fragment: str) -> int:
    program = int(GL.glCreateProgram())
    for kind, source in ((GL.GL_VERTEX_SHADER, vertex), (GL.GL_FRAGMENT_SHADER, fragment)):
        shader = GL.glCreateShader(kind)
        GL.glShaderSource(shader, source)
        GL.glCompileShader(shader)
        if not GL.glGetShaderiv(shader, GL.GL_COMPILE_STATUS):
            raise _refused(GL, GL.glGetShaderInfoLog(shader))
        GL.glAttachShader(program, shader)
        GL.glDeleteShader(shader)  # goes with the program
    for location, name in enumerate(ATTRIBUTES):
        GL.glBindAttribLocation(program, location, name)
    GL.glLinkProgram(program)
    if not GL.glGetProgramiv(program, GL.GL_LINK_STATUS):
        raise _refused(GL, GL.glGetProgramInfoLog(program))
    GL.glUseProgram(program)
    for name, unit in TEXTURE_UNITS.items():
        GL.glUniform1i(GL.glGetUniformLocation(program, name), unit)
    return program


def _refused(GL: Any, log: bytes | str) -> MemobenchError:
    text = log.decode(errors="replace") if isinstance(log, bytes) else log
    version = GL.glGetString(GL.GL_VERSION)
    return MemobenchError(
        f"the GL driver ({version.decode() if version else 'unknown'}) refused a shader: "
        f"{' '.join(text.split())}; OpenGL 3.1 is needed, try MUJOCO_GL=osmesa"
    )
