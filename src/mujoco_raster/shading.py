"""Shade pixels: compute light at vertices, and textures per pixel.

Pixels are shaded in batches with vectorised loops. All rows of `BATCH` numbers lie in one array, so that the compiler
can prove that they do not overlap.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoco_raster.compiled import compiled
from mujoco_raster.drawlist import POSITION, ROW

Floats = NDArray[np.float32]
Integers = NDArray[np.int32]

BATCH = 256
CHUNK = 16
"""Pixels are appended to a batch in whole chunks; surplus numbers are overwritten or unused. Indices are unsigned in
these loops, because numba checks signed ones for negative values, which prevents vectorisation."""
STRIDE = BATCH + CHUNK
ATTRIBUTES = 5
"""Attributes per vertex: light (3), texture coordinates (2)."""
IMAGE, TRANSLUCENT = 0, 1
"""Output modes: write the image, blend over the image."""

# Float rows of a batch: the attributes, followed by
_INVERSE, _LEVEL, _SHARE, _PAINT, _ACROSS, _DOWN, _FLOAT_ROWS = 5, 6, 7, 8, 11, 12, 13
# Float rows of a batch of vertices: light (3), followed by
_POINT, _NORMAL, _VIEW, _TO, _COLOUR, _STRENGTH, _SPECULAR, _SHININESS, _VERTEX_ROWS = 3, 6, 9, 12, 15, 18, 19, 20, 21
# Integer rows of a batch: pixel, start of the texture, level, start of the level, side of the level, addresses of four
# texels, the four texels.
_WHERE, _LAYER, _BELOW, _OFFSET, _SIDE, _ADDRESS, _TEXEL, _INTEGER_ROWS = 0, 1, 2, 3, 4, 5, 9, 13

_0, _1, _HALF, _255 = np.float32(0), np.float32(1), np.float32(0.5), np.float32(255)
_TINY = np.float32(1e-30)


class Surfaces(NamedTuple):
    """Vertex attributes and textures of a scene.

    ``vertices`` and ``origin``: (N, 8), see `drawlist.DrawList`; ``texels``: all levels of all layers, one byte of red,
    green and blue each per integer; ``side``: side of the first level, a power of two; ``detail``: its area, times the
    pixels that are averaged to one.
    """

    vertices: Floats
    origin: Integers
    texels: Integers
    side: int
    detail: float


class Scratch(NamedTuple):
    """Buffers for intermediate results, created by `scratch`.

    Visible triangles are listed, which keeps their data together in memory: ``triangles``, ``rows`` and ``planes``;
    ``corners`` (S, 3), indices of ``vertices`` and their ``attributes``. ``slot_of_triangle`` and ``slot_of_vertex``:
    index in these lists, valid if the list agrees. ``runs``: first pixel, number of pixels, triangle. ``ramp``: 0, 1 …
    """

    slot_of_triangle: Integers
    slot_of_vertex: Integers
    triangles: Integers
    rows: Integers
    corners: Integers
    vertices: Integers
    attributes: Floats
    planes: NDArray[np.float64]
    runs: Integers
    ramp: Floats
    floats: Floats
    integers: Integers


def scratch(vertices: int, triangles: int, pixels: int) -> Scratch:
    """Return buffers for a scene and an image size."""
    shown = min(triangles, pixels)
    used = min(vertices, 3 * shown)
    return Scratch(
        np.zeros(triangles, np.int32),
        np.zeros(vertices, np.int32),
        np.zeros(shown, np.int32),
        np.zeros(shown, np.int32),
        np.zeros((shown, 3), np.int32),
        np.zeros(used, np.int32),
        np.zeros((used, ATTRIBUTES), np.float32),
        np.zeros((shown, ATTRIBUTES + 1, 3)),
        np.zeros((pixels, 3), np.int32),
        np.arange(BATCH, dtype=np.float32),
        np.zeros(_VERTEX_ROWS * STRIDE, np.float32),
        np.zeros(_INTEGER_ROWS * STRIDE, np.int32),
    )


@compiled
def shade(
    shapes: Any, surfaces: Any, table: Any, lights: Any, eye: Any, clip: Any, target: Any, work: Any, mode: Any,
    image: Any,
) -> None:  # fmt: skip
    """Shade every pixel with a visible triangle.

    Args:
        shapes, table, clip, target: after a call of `geometry.draw_triangles`.
        surfaces: `Surfaces`.
        lights: `view.Lights`.
        eye: position of the camera, (3,).
        work: `Scratch`.
        mode: `IMAGE` or `TRANSLUCENT`.
        image: (H * W, 3) uint8, updated.
    """
    height, width = target.triangle.shape
    runs = _find_runs(target.triangle, work.runs)
    vertices, triangles = _list_shown(runs, shapes.triangles, surfaces.origin, work)
    _light(work.vertices[:vertices], shapes, surfaces, table, lights, eye, work.attributes, work.floats)
    _set_up(triangles, shapes.corners, clip, width, height, work)
    t, i, texels, side = work.floats, work.integers, surfaces.texels, surfaces.side
    size = (4 * side * side - 1) // 3  # of all levels of a layer
    for textured in (False, True):
        count = 0
        for n in range(runs + 1):  # the last iteration flushes the incomplete batch
            start: Any = 0
            length: Any = 0
            slot: Any = 0
            layer: Any = 0
            alpha: Any = _1
            if n < runs:
                start, length, slot = int(work.runs[n, 0]), int(work.runs[n, 1]), int(work.runs[n, 2])
                row = work.rows[slot]
                layer = int(table[row, 4, 3])
                if (layer > 0) != textured:
                    continue
                alpha = min(max(table[row, 3, 3], _0), _1)
            done = 0
            while done < length or (n == runs and count > 0):
                here = min(length - done, BATCH - count)
                if here > 0:
                    pixel = start + done
                    _fill(work.planes, slot, pixel, width, here, count, textured, work.ramp, t, i)
                    if textured:
                        _choose_levels(
                            *(work.planes, slot, pixel, width, here, count, layer * size),
                            *(surfaces.detail, work.ramp, t, i),
                        )
                    done += here
                    count += here
                if count == BATCH or n == runs or (mode == TRANSLUCENT and done == length):
                    if count < BATCH:
                        _rest(count, t, i)
                    _colour(textured, texels, side, t, i)
                    _write(count, mode, alpha, image, t, i)
                    count = 0


@compiled
def _find_runs(triangle: Any, runs: Any) -> Any:
    """Find horizontal runs of pixels with one triangle: first pixel, length, triangle; return their number."""
    height, width = triangle.shape
    count = 0
    for y in range(height):
        x = 0
        while x < width:
            shown = triangle[y, x]
            start = x
            x += 1
            if shown < 0:
                continue
            while x < width and triangle[y, x] == shown:
                x += 1
            runs[count, 0], runs[count, 1], runs[count, 2] = y * width + start, x - start, shown
            count += 1
    return count


@compiled
def _list_shown(runs: Any, vertices_of: Any, origin: Any, work: Any) -> Any:
    """List the triangles of runs and their vertices; return the numbers of vertices and triangles.

    Args:
        runs: number of runs; their triangles are replaced by indices in the list.
        vertices_of: (T, 3).
        origin: see `Surfaces`.
        work: `Scratch`.
    """
    vertices, triangles = 0, 0
    for n in range(runs):
        triangle = work.runs[n, 2]
        slot = work.slot_of_triangle[triangle]
        if slot >= triangles or work.triangles[slot] != triangle:
            slot = triangles
            triangles += 1
            work.slot_of_triangle[triangle], work.triangles[slot] = slot, triangle
            work.rows[slot] = origin[vertices_of[triangle, 0], ROW]
            for corner in range(3):
                vertex = vertices_of[triangle, corner]
                at = work.slot_of_vertex[vertex]
                if at >= vertices or work.vertices[at] != vertex:
                    at = vertices
                    vertices += 1
                    work.slot_of_vertex[vertex], work.vertices[at] = at, vertex
                work.corners[slot, corner] = at
        work.runs[n, 2] = slot
    return vertices, triangles


# --- vertices ---


@compiled
def _rough_log2(value: Any) -> Any:
    """Return the base-2 logarithm of a positive number within 2e-5 (polynomial fitted at Chebyshev nodes)."""
    bits = np.float64(value).view(np.int64)
    m = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    series = -2.79416749 + m * (5.06979932 + m * (-3.52027091 + m * (1.61020813 + m * (-0.40948426 + m * 0.04392957))))
    return (bits >> 52) - 1023 + series


@compiled
def _power(base: Any, exponent: Any) -> Any:
    """Return the power of a number from 0 to 1 within 1e-6, by bit-reproducible operations without branches."""
    bits = np.float64(max(base, 1e-30)).view(np.int64)
    exponent_of_base = np.int32(bits >> 52) - np.int32(1023)
    mantissa = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    large = mantissa > 1.4142135623730951
    mantissa = mantissa * 0.5 if large else mantissa
    exponent_of_base = np.int32(exponent_of_base + np.int32(large))
    s = (mantissa - 1.0) / (mantissa + 1.0)
    q = s * s
    series = 1.0 + q * (1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * (1.0 / 9.0))))
    product = exponent * (exponent_of_base + 2.8853900817779268 * s * series)
    small = base <= 0.0 or product < -60.0
    product = max(product, -60.0)
    whole = math.floor(product + 0.5)
    x = (product - whole) * 0.6931471805599453
    series = 1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))))
    power = series * np.int64(np.int64(np.int32(whole) + np.int32(1023)) << 52).view(np.float64)
    return 0.0 if small else power


@compiled
def _light(
    vertices: Any, shapes: Any, surfaces: Any, table: Any, lights: Any, eye: Any, attributes: Any, t: Any
) -> None:
    """Compute the attributes of vertices: MuJoCo's light with Blinn's specular term, clipped to 1."""
    for start in range(0, vertices.size, BATCH):
        count = min(BATCH, vertices.size - start)
        _gather(vertices[start : start + count], shapes, surfaces, table, t)
        _face(eye, t)
        for n in range(lights.to.shape[0]):
            _reach(lights, n, t)
            _add_light(lights, n, t)
        for k in range(count):
            i, at = vertices[start + k], start + k
            for c in range(3):
                attributes[at, c] = min(t[c * STRIDE + k], _1)
            attributes[at, 3], attributes[at, 4] = surfaces.vertices[i, 3], surfaces.vertices[i, 4]


@compiled
def _gather(vertices: Any, shapes: Any, surfaces: Any, table: Any, t: Any) -> None:
    """Write positions and normals in the world, and materials, of a batch of vertices."""
    for k in range(vertices.size):
        i = vertices[k]
        point, row = surfaces.origin[i, POSITION], surfaces.origin[i, ROW]
        pose, colour = table[row], table[row, 3]
        emission = table[row, 4, 2]
        x, y, z = shapes.position[0, point], shapes.position[1, point], shapes.position[2, point]
        a, b, c = surfaces.vertices[i, 0], surfaces.vertices[i, 1], surfaces.vertices[i, 2]
        for axis in range(3):
            m, n, o = pose[axis, 0], pose[axis, 1], pose[axis, 2]
            t[(_POINT + axis) * STRIDE + k] = m * x + n * y + o * z + pose[axis, 3]
            t[(_NORMAL + axis) * STRIDE + k] = m * a + n * b + o * c
            t[axis * STRIDE + k] = emission * colour[axis]
            t[(_COLOUR + axis) * STRIDE + k] = colour[axis]
        t[_SPECULAR * STRIDE + k], t[_SHININESS * STRIDE + k] = table[row, 4, 0], table[row, 4, 1]


@compiled
def _face(eye: Any, t: Any) -> None:
    """Normalise the normals, and compute the directions to the camera."""
    ex, ey, ez = eye[0], eye[1], eye[2]
    for x in range(BATCH):
        nx, ny, nz = t[_NORMAL * STRIDE + x], t[(_NORMAL + 1) * STRIDE + x], t[(_NORMAL + 2) * STRIDE + x]
        scale = _1 / math.sqrt(max(nx * nx + ny * ny + nz * nz, _TINY))
        t[_NORMAL * STRIDE + x], t[(_NORMAL + 1) * STRIDE + x] = nx * scale, ny * scale
        t[(_NORMAL + 2) * STRIDE + x] = nz * scale
        vx, vy = ex - t[_POINT * STRIDE + x], ey - t[(_POINT + 1) * STRIDE + x]
        vz = ez - t[(_POINT + 2) * STRIDE + x]
        scale = _1 / math.sqrt(max(vx * vx + vy * vy + vz * vz, _TINY))
        t[_VIEW * STRIDE + x], t[(_VIEW + 1) * STRIDE + x] = vx * scale, vy * scale
        t[(_VIEW + 2) * STRIDE + x] = vz * scale


@compiled
def _reach(lights: Any, n: Any, t: Any) -> None:
    """Compute the direction to a light and its strength at each vertex of a batch."""
    tx, ty, tz = lights.to[n, 0], lights.to[n, 1], lights.to[n, 2]
    if not lights.placed[n]:
        for x in range(BATCH):
            t[_TO * STRIDE + x], t[(_TO + 1) * STRIDE + x], t[(_TO + 2) * STRIDE + x] = tx, ty, tz
            t[_STRENGTH * STRIDE + x] = _1
        return
    ax, ay, az = lights.axis[n, 0], lights.axis[n, 1], lights.axis[n, 2]
    constant, linear, quadratic = lights.attenuation[n, 0], lights.attenuation[n, 1], lights.attenuation[n, 2]
    cosine, falloff = lights.cone[n, 0], lights.cone[n, 1]
    spot = cosine > np.float32(-1)
    for x in range(BATCH):
        lx, ly = tx - t[_POINT * STRIDE + x], ty - t[(_POINT + 1) * STRIDE + x]
        lz = tz - t[(_POINT + 2) * STRIDE + x]
        distance = math.sqrt(max(lx * lx + ly * ly + lz * lz, _TINY))
        lx, ly, lz = lx / distance, ly / distance, lz / distance
        along = -(lx * ax + ly * ay + lz * az)
        strength = _1
        if spot:
            strength = np.float32(_power(along, falloff)) if along >= cosine else _0
        strength /= constant + distance * (linear + distance * quadratic)
        t[_TO * STRIDE + x], t[(_TO + 1) * STRIDE + x], t[(_TO + 2) * STRIDE + x] = lx, ly, lz
        t[_STRENGTH * STRIDE + x] = strength


@compiled
def _add_light(lights: Any, n: Any, t: Any) -> None:
    """Add the light of one source to a batch of vertices."""
    a0, a1, a2 = lights.ambient[n, 0], lights.ambient[n, 1], lights.ambient[n, 2]
    d0, d1, d2 = lights.diffuse[n, 0], lights.diffuse[n, 1], lights.diffuse[n, 2]
    s0, s1, s2 = lights.specular[n, 0], lights.specular[n, 1], lights.specular[n, 2]
    for x in range(BATCH):
        lx, ly, lz = t[_TO * STRIDE + x], t[(_TO + 1) * STRIDE + x], t[(_TO + 2) * STRIDE + x]
        nx, ny, nz = t[_NORMAL * STRIDE + x], t[(_NORMAL + 1) * STRIDE + x], t[(_NORMAL + 2) * STRIDE + x]
        hx, hy, hz = lx + t[_VIEW * STRIDE + x], ly + t[(_VIEW + 1) * STRIDE + x], lz + t[(_VIEW + 2) * STRIDE + x]
        strength, specular = t[_STRENGTH * STRIDE + x], t[_SPECULAR * STRIDE + x]
        facing = nx * lx + ny * ly + nz * lz
        towards = (nx * hx + ny * hy + nz * hz) / math.sqrt(max(hx * hx + hy * hy + hz * hz, _TINY))
        glint = np.float32(_power(min(towards, _1), max(t[_SHININESS * STRIDE + x], _0))) * specular
        glint = glint if specular > _0 else _0
        lit = strength if facing > _0 and strength > _0 else _0
        r, g, b = t[_COLOUR * STRIDE + x], t[(_COLOUR + 1) * STRIDE + x], t[(_COLOUR + 2) * STRIDE + x]
        t[x] = t[x] + strength * a0 * r + lit * (facing * d0 * r + glint * s0)
        t[STRIDE + x] = t[STRIDE + x] + strength * a1 * g + lit * (facing * d1 * g + glint * s1)
        t[2 * STRIDE + x] = t[2 * STRIDE + x] + strength * a2 * b + lit * (facing * d2 * b + glint * s2)


@compiled
def _set_up(triangles: Any, corners: Any, clip: Any, width: Any, height: Any, work: Any) -> None:
    """Compute the plane equations of attributes divided by distance, and of the inverse distance, over the image.

    Args:
        triangles: number of listed triangles.
        corners: (T, 3).
        clip, width, height: see `geometry.draw_triangles`.
        work: `Scratch`. ``planes``: (S, ATTRIBUTES + 1, 3), overwritten: change per pixel to the right, change per
            pixel down, value at the first pixel.
    """
    half_width, half_height = 0.5 * width, 0.5 * height
    planes, attributes = work.planes, work.attributes
    for slot in range(triangles):
        triangle = work.triangles[slot]
        i, j, k = corners[triangle, 0], corners[triangle, 1], corners[triangle, 2]
        w0, w1, w2 = float(clip.w[i]), float(clip.w[j]), float(clip.w[k])
        x0, y0 = (clip.x[i] + w0) * half_width, (clip.y[i] + w0) * half_height
        x1, y1 = (clip.x[j] + w1) * half_width, (clip.y[j] + w1) * half_height
        x2, y2 = (clip.x[k] + w2) * half_width, (clip.y[k] + w2) * half_height
        a0, b0, c0 = y1 * w2 - y2 * w1, x2 * w1 - x1 * w2, x1 * y2 - x2 * y1
        a1, b1, c1 = y2 * w0 - y0 * w2, x0 * w2 - x2 * w0, x2 * y0 - x0 * y2
        a2, b2, c2 = y0 * w1 - y1 * w0, x1 * w0 - x0 * w1, x0 * y1 - x1 * y0
        scale = 1.0 / (a0 * x0 + b0 * y0 + c0 * w0)
        c0, c1, c2 = c0 + 0.5 * (a0 + b0), c1 + 0.5 * (a1 + b1), c2 + 0.5 * (a2 + b2)
        a0, b0, c0 = a0 * scale, b0 * scale, c0 * scale
        a1, b1, c1 = a1 * scale, b1 * scale, c1 * scale
        a2, b2, c2 = a2 * scale, b2 * scale, c2 * scale
        i, j, k = work.corners[slot, 0], work.corners[slot, 1], work.corners[slot, 2]
        for n in range(ATTRIBUTES):
            p, q, r = attributes[i, n], attributes[j, n], attributes[k, n]
            planes[slot, n, 0] = a0 * p + a1 * q + a2 * r
            planes[slot, n, 1] = b0 * p + b1 * q + b2 * r
            planes[slot, n, 2] = c0 * p + c1 * q + c2 * r
        planes[slot, _INVERSE, 0] = a0 + a1 + a2
        planes[slot, _INVERSE, 1] = b0 + b1 + b2
        planes[slot, _INVERSE, 2] = c0 + c1 + c2


# --- batches of pixels ---


@compiled
def _fill(
    planes: Any, slot: Any, pixel: Any, width: Any, length: Any, count: Any, textured: Any, ramp: Any,
    t: Any, i: Any,
) -> None:  # fmt: skip
    """Append a run of pixels of one triangle from ``pixel`` to the batch, which holds ``count``."""
    whole = (length + CHUNK - 1) // CHUNK * CHUNK
    y = pixel // width
    x = pixel - y * width
    for n in range(ATTRIBUTES + 1):
        if 3 <= n < 5 and not textured:
            continue
        at = np.float32(planes[slot, n, 0] * x + (planes[slot, n, 1] * y + planes[slot, n, 2]))
        slope = np.float32(planes[slot, n, 0])
        first = n * STRIDE + count
        for k in range(whole):
            t[np.uint64(first + k)] = at + slope * ramp[k]
    first = _WHERE * STRIDE + count
    for k in range(whole):
        i[np.uint64(first + k)] = np.int32(pixel + k)


@compiled
def _choose_levels(
    planes: Any, slot: Any, pixel: Any, width: Any, length: Any, count: Any, offset: Any, detail: Any, ramp: Any,
    t: Any, i: Any,
) -> None:  # fmt: skip
    """Choose mipmap levels from the number of texels per pixel at both ends of a run."""
    y = pixel // width
    first, step = 0.0, 0.0
    e, f, g = planes[slot, _INVERSE, 0], planes[slot, _INVERSE, 1], planes[slot, _INVERSE, 2]
    a, b, c = planes[slot, 3, 0], planes[slot, 3, 1], planes[slot, 3, 2]
    p, q, r = planes[slot, 4, 0], planes[slot, 4, 1], planes[slot, 4, 2]
    for end in range(1 if length == 1 else 2):
        x = pixel - y * width + end * (length - 1)
        distance = 1.0 / (e * x + f * y + g)
        u, v = (a * x + b * y + c) * distance, (p * x + q * y + r) * distance
        u_across, u_down, v_across, v_down = a - u * e, b - u * f, p - v * e, q - v * f
        covered = max(u_across * u_across + v_across * v_across, u_down * u_down + v_down * v_down)
        level = 0.5 * _rough_log2(max(covered * (distance * distance) * detail, 1e-12))
        if end == 0:
            first = level
        else:
            step = (level - first) / (length - 1)
    at, slope = np.float32(first), np.float32(step)
    layer = np.int32(offset)
    whole = (length + CHUNK - 1) // CHUNK * CHUNK
    for k in range(whole):
        t[np.uint64(_LEVEL * STRIDE + count + k)] = at + slope * ramp[k]
    for k in range(whole):
        i[np.uint64(_LAYER * STRIDE + count + k)] = layer


@compiled
def _rest(count: Any, t: Any, i: Any) -> None:
    """Fill the rest of the last batch with valid numbers."""
    for n in range(_FLOAT_ROWS):
        value = _1 if n == _INVERSE else _0
        for k in range(count, BATCH):
            t[n * STRIDE + k] = value
    for n in range(_INTEGER_ROWS):
        for k in range(count, BATCH):
            i[n * STRIDE + k] = 0


@compiled
def _colour(textured: Any, texels: Any, side: Any, t: Any, i: Any) -> None:
    """Compute the colours of a batch into its first three rows."""
    _divide(t, textured)
    if textured:
        mixed = _begin_sampling(side, t, i)
        _sample(texels, side, t, i)
        if mixed:
            _next_level(t, i)
            _sample(texels, side, t, i)
    else:
        for x in range(_PAINT * STRIDE, (_PAINT + 3) * STRIDE):
            t[x] = _255
    _paint(t)


@compiled
def _write(count: Any, mode: Any, alpha: Any, image: Any, t: Any, i: Any) -> None:
    """Write the first ``count`` pixels of a batch to the output of the mode."""
    if mode == IMAGE:
        for x in range(3 * STRIDE):
            t[x] = min(max(t[x], _0), _255) + _HALF
        for k in range(count):
            where = i[_WHERE * STRIDE + k]
            for c in range(3):
                image[where, c] = np.uint8(t[c * STRIDE + k])
    else:
        for k in range(count):
            where = i[_WHERE * STRIDE + k]
            for c in range(3):
                colour, under = min(max(t[c * STRIDE + k], _0), _255), np.float32(image[where, c])
                image[where, c] = np.uint8(alpha * colour + (_1 - alpha) * under + _HALF)


@compiled
def _divide(t: Any, textured: Any) -> None:
    """Multiply the attributes by the distance (perspective correction)."""
    for x in range(BATCH):
        t[_INVERSE * STRIDE + x] = _1 / t[_INVERSE * STRIDE + x]
    for x in range(BATCH):
        distance = t[_INVERSE * STRIDE + x]
        t[x] *= distance
        t[STRIDE + x] *= distance
        t[2 * STRIDE + x] *= distance
    if textured:
        for x in range(BATCH):
            distance = t[_INVERSE * STRIDE + x]
            t[3 * STRIDE + x] *= distance
            t[4 * STRIDE + x] *= distance


@compiled
def _paint(t: Any) -> None:
    """Multiply light by texture colours."""
    for x in range(BATCH):
        t[x] *= t[_PAINT * STRIDE + x]
        t[STRIDE + x] *= t[(_PAINT + 1) * STRIDE + x]
        t[2 * STRIDE + x] *= t[(_PAINT + 2) * STRIDE + x]


@compiled
def _begin_sampling(side: Any, t: Any, i: Any) -> Any:
    """Select the lower of two mipmap levels and clear the colours; return whether the upper level is needed."""
    coarsest = _0
    while side > 1:
        side, coarsest = side // 2, coarsest + _1
    coarsest -= np.float32(0.001)
    most = _0
    for x in range(BATCH):
        level = min(max(t[_LEVEL * STRIDE + x], _0), coarsest)
        most = max(most, level)
        below = np.int32(level)
        i[_BELOW * STRIDE + x] = below
        t[_LEVEL * STRIDE + x] = level - np.float32(below)
        t[_SHARE * STRIDE + x] = _1
    for x in range(_PAINT * STRIDE, (_PAINT + 3) * STRIDE):
        t[x] = _0
    return most > _0


@compiled
def _next_level(t: Any, i: Any) -> None:
    """Select the upper of two mipmap levels with its weight."""
    for x in range(BATCH):
        i[_BELOW * STRIDE + x] += np.int32(1)
        t[_SHARE * STRIDE + x] = t[_LEVEL * STRIDE + x]


@compiled
def _sample(texels: Any, side: Any, t: Any, i: Any) -> None:
    """Interpolate textures bilinearly at a level, and blend them into the colours of the previous level."""
    whole = np.int32(side)
    area = np.int32(whole * whole)
    for x in range(BATCH):
        here = np.int32(whole >> i[_BELOW * STRIDE + x])
        i[_SIDE * STRIDE + x] = here
        # The previous levels contain 4/3 of the difference of areas.
        before = np.uint32(np.int32(area - np.int32(here * here)) << np.int32(2)) // np.uint32(3)
        i[_OFFSET * STRIDE + x] = np.int32(i[_LAYER * STRIDE + x] + np.int32(before))
    for x in range(BATCH):
        side_here = i[_SIDE * STRIDE + x]
        a = t[3 * STRIDE + x] * np.float32(side_here) - _HALF
        b = t[4 * STRIDE + x] * np.float32(side_here) - _HALF
        left, top = np.int32(a), np.int32(b)
        left = np.int32(left - np.int32(np.float32(left) > a))
        top = np.int32(top - np.int32(np.float32(top) > b))
        t[_ACROSS * STRIDE + x] = a - np.float32(left)
        t[_DOWN * STRIDE + x] = b - np.float32(top)
        mask = np.int32(side_here - np.int32(1))
        here, there = np.int32(left & mask), np.int32(np.int32(left + np.int32(1)) & mask)
        above = np.int32(i[_OFFSET * STRIDE + x] + np.int32(np.int32(top & mask) * side_here))
        below = np.int32(i[_OFFSET * STRIDE + x] + np.int32(np.int32(np.int32(top + np.int32(1)) & mask) * side_here))
        i[_ADDRESS * STRIDE + x] = np.int32(above + here)
        i[(_ADDRESS + 1) * STRIDE + x] = np.int32(above + there)
        i[(_ADDRESS + 2) * STRIDE + x] = np.int32(below + here)
        i[(_ADDRESS + 3) * STRIDE + x] = np.int32(below + there)
    for x in range(BATCH):
        i[_TEXEL * STRIDE + x] = texels[np.uint32(i[_ADDRESS * STRIDE + x])]
        i[(_TEXEL + 1) * STRIDE + x] = texels[np.uint32(i[(_ADDRESS + 1) * STRIDE + x])]
        i[(_TEXEL + 2) * STRIDE + x] = texels[np.uint32(i[(_ADDRESS + 2) * STRIDE + x])]
        i[(_TEXEL + 3) * STRIDE + x] = texels[np.uint32(i[(_ADDRESS + 3) * STRIDE + x])]
    for x in range(BATCH):
        across, down, share = t[_ACROSS * STRIDE + x], t[_DOWN * STRIDE + x], t[_SHARE * STRIDE + x]
        p, q = i[_TEXEL * STRIDE + x], i[(_TEXEL + 1) * STRIDE + x]
        r, s = i[(_TEXEL + 2) * STRIDE + x], i[(_TEXEL + 3) * STRIDE + x]
        last = across * down
        first, second, third = _1 - across - down + last, across - last, down - last
        byte, green, blue = np.int32(255), np.int32(8), np.int32(16)
        value = first * np.float32(p & byte) + second * np.float32(q & byte)
        value = value + third * np.float32(r & byte) + last * np.float32(s & byte)
        before = t[_PAINT * STRIDE + x]
        t[_PAINT * STRIDE + x] = before + share * (value - before)
        value = first * np.float32(p >> green & byte) + second * np.float32(q >> green & byte)
        value = value + third * np.float32(r >> green & byte) + last * np.float32(s >> green & byte)
        before = t[(_PAINT + 1) * STRIDE + x]
        t[(_PAINT + 1) * STRIDE + x] = before + share * (value - before)
        value = first * np.float32(p >> blue) + second * np.float32(q >> blue)
        value = value + third * np.float32(r >> blue) + last * np.float32(s >> blue)
        before = t[(_PAINT + 2) * STRIDE + x]
        t[(_PAINT + 2) * STRIDE + x] = before + share * (value - before)
