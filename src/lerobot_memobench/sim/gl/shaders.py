"""The GLSL programs: a scene in MuJoCo's light, the shadow map of one light, and which geom a pixel shows."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_memobench.errors import MemobenchError

_VERTEX_SHADER = """#version 140
const int LIGHTS = %(lights)d;
const int CASTER = %(caster)d;
uniform samplerBuffer geoms;
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

_PLACE = """\
uniform samplerBuffer geoms;
in vec3 position;
in float geom;
vec3 place() {
    int row = 5 * int(geom + 0.5);
    vec4 local = vec4(position, 1.0);
    return vec3(
        dot(texelFetch(geoms, row), local),
        dot(texelFetch(geoms, row + 1), local),
        dot(texelFetch(geoms, row + 2), local));
}"""
"""Where in the world a vertex is, by its geom's row of the table."""

_SHADOW_VERTEX_SHADER = f"""#version 140
{_PLACE}
layout(std140) uniform Frame {{ mat4 light; }};
void main() {{
    gl_Position = light * vec4(place(), 1.0);
}}
"""

_SHADOW_FRAGMENT_SHADER = """#version 140
void main() {}
"""

_GEOM_VERTEX_SHADER = f"""#version 140
{_PLACE}
layout(std140) uniform Frame {{ mat4 light; mat4 projection; }};
out float code;
void main() {{
    code = geom + 1.0;
    gl_Position = projection * vec4(place(), 1.0);
}}
"""

_GEOM_FRAGMENT_SHADER = """#version 140
in float code;
out vec4 pixel;
void main() {
    float whole = floor(code + 0.5);
    pixel = vec4(mod(whole, 256.0), floor(whole / 256.0), 0.0, 255.0) / 255.0;
}
"""

ATTRIBUTES = ("position", "normal", "uv", "geom")
"""What a vertex has, by location."""

TEXTURE_UNITS = {"geoms": 0, "textures": 1, "shadows": 2}
"""Unit of each sampler: the table of geoms, their textures, the shadow map."""


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


def scene_program(GL: Any, lights: int, caster: int | None) -> int:
    """Compile the program that draws a scene and leave it in use.

    Args:
        GL: PyOpenGL's module; a context is current.
        lights: how many there are.
        caster: which of them casts shadows, None for none.
    """
    vertex = _VERTEX_SHADER % {"lights": lights, "caster": -1 if caster is None else caster}
    fragment = _FRAGMENT_SHADER % {"lit": "1.0" if caster is None else "texture(shadows, shade)"}
    return _program(GL, vertex, fragment)


def shadow_program(GL: Any) -> int:
    """Compile the program that draws depths as a light sees them, and leave it in use."""
    return _program(GL, _SHADOW_VERTEX_SHADER, _SHADOW_FRAGMENT_SHADER)


def geom_program(GL: Any) -> int:
    """Compile the program that draws each geom in the colour of its row + 1, low byte red, high byte green."""
    return _program(GL, _GEOM_VERTEX_SHADER, _GEOM_FRAGMENT_SHADER)


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
