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
# Integer rows of a batch: pixel, start of the texture, level, start of the level, side of the level, addresses of four
# texels, the four texels.
_WHERE, _LAYER, _BELOW, _OFFSET, _SIDE, _ADDRESS, _TEXEL, _INTEGER_ROWS = 0, 1, 2, 3, 4, 5, 9, 13

_0, _1, _HALF, _255 = np.float32(0), np.float32(1), np.float32(0.5), np.float32(255)
_TINY = np.float32(1e-30)


class Surfaces(NamedTuple):
    """Vertex attributes and textures of a scene.

    ``normal``: (N, 3) in the frames of the rows; ``uv``: (N, 2); ``row``: (N,); ``texels``: all levels of all layers,
    one byte of red, green and blue each per integer; ``side``: side of the first level, a power of two; ``detail``: its
    area, times the pixels that are averaged to one.
    """

    normal: Floats
    uv: Floats
    row: Integers
    texels: Integers
    side: int
    detail: float


class Scratch(NamedTuple):
    """Buffers for intermediate results, created by `scratch`.

    ``listed_vertex`` (N,) and ``listed_triangle`` (T,): stamp of the last call that listed them. ``vertices`` and
    ``triangles``: visible ones; ``slot``: (T,), index of a triangle in the list. ``attributes``: of the vertices;
    ``planes``: of the listed triangles. ``runs``: first pixel, number of pixels, triangle. ``ramp``: 0, 1, 2 …
    """

    stamp: NDArray[np.int64]
    listed_vertex: NDArray[np.int64]
    listed_triangle: NDArray[np.int64]
    vertices: Integers
    triangles: Integers
    slot: Integers
    attributes: Floats
    planes: NDArray[np.float64]
    runs: Integers
    ramp: Floats
    floats: Floats
    integers: Integers


def scratch(vertices: int, triangles: int, pixels: int) -> Scratch:
    """Return buffers for a scene and an image size."""
    shown = min(triangles, pixels)
    return Scratch(
        np.zeros(1, np.int64),
        np.zeros(vertices, np.int64),
        np.zeros(triangles, np.int64),
        np.zeros(vertices, np.int32),
        np.zeros(shown, np.int32),
        np.zeros(triangles, np.int32),
        np.zeros((vertices, ATTRIBUTES), np.float32),
        np.zeros((shown, ATTRIBUTES + 1, 3)),
        np.zeros((pixels, 3), np.int32),
        np.arange(BATCH, dtype=np.float32),
        np.zeros(_FLOAT_ROWS * STRIDE, np.float32),
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
        lights: `lights.Lights`.
        eye: position of the camera, (3,).
        work: `Scratch`.
        mode: `IMAGE` or `TRANSLUCENT`.
        image: (H * W, 3) uint8, updated.
    """
    height, width = target.triangle.shape
    runs = _find_runs(target.triangle, work.runs)
    vertices, triangles = _list_shown(runs, shapes.triangles, work)
    _light(work.vertices[:vertices], shapes.position, surfaces, table, lights, eye, work.attributes)
    _set_up(work.triangles[:triangles], shapes.triangles, clip, width, height, work.attributes, work.planes)
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
                start, length = int(work.runs[n, 0]), int(work.runs[n, 1])
                triangle = work.runs[n, 2]
                row = surfaces.row[shapes.triangles[triangle, 0]]
                layer = int(table[row, 4, 3])
                if (layer > 0) != textured:
                    continue
                slot, alpha = int(work.slot[triangle]), min(max(table[row, 3, 3], _0), _1)
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
def _list_shown(runs: Any, corners: Any, work: Any) -> Any:
    """List the triangles of runs and their vertices; return the numbers of vertices and triangles."""
    work.stamp[0] += 1
    stamp = work.stamp[0]
    vertices, triangles = 0, 0
    for n in range(runs):
        triangle = work.runs[n, 2]
        if work.listed_triangle[triangle] == stamp:
            continue
        work.listed_triangle[triangle] = stamp
        work.triangles[triangles], work.slot[triangle] = triangle, triangles
        triangles += 1
        for corner in range(3):
            vertex = corners[triangle, corner]
            if work.listed_vertex[vertex] != stamp:
                work.listed_vertex[vertex] = stamp
                work.vertices[vertices] = vertex
                vertices += 1
    return vertices, triangles


# --- vertices ---


@compiled
def _log2(value: Any) -> Any:
    """Return the base-2 logarithm of a positive number within 1e-7, by bit-reproducible operations."""
    bits = np.float64(value).view(np.int64)
    exponent = (bits >> 52) - 1023
    mantissa = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    if mantissa > 1.4142135623730951:
        mantissa *= 0.5
        exponent += 1
    s = (mantissa - 1.0) / (mantissa + 1.0)
    q = s * s
    series = 1.0 + q * (1.0 / 3.0 + q * (1.0 / 5.0 + q * (1.0 / 7.0 + q * (1.0 / 9.0))))
    return exponent + 2.8853900817779268 * s * series


@compiled
def _rough_log2(value: Any) -> Any:
    """Return the base-2 logarithm of a positive number within 2e-5 (polynomial fitted at Chebyshev nodes)."""
    bits = np.float64(value).view(np.int64)
    m = np.int64((bits & 0xFFFFFFFFFFFFF) | 0x3FF0000000000000).view(np.float64)
    series = -2.79416749 + m * (5.06979932 + m * (-3.52027091 + m * (1.61020813 + m * (-0.40948426 + m * 0.04392957))))
    return (bits >> 52) - 1023 + series


@compiled
def _power(base: Any, exponent: Any) -> Any:
    """Return the power of a number from 0 to 1 within 1e-6, by bit-reproducible operations."""
    if base <= 0.0:
        return 0.0
    product = exponent * _log2(base)
    if product < -60.0:
        return 0.0
    whole = math.floor(product + 0.5)
    x = (product - whole) * 0.6931471805599453
    series = 1.0 + x * (1.0 + x / 2.0 * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0)))))
    return series * np.int64((np.int64(whole) + 1023) << 52).view(np.float64)


@compiled
def _light(vertices: Any, position: Any, surfaces: Any, table: Any, lights: Any, eye: Any, attributes: Any) -> None:
    """Compute the attributes of vertices: MuJoCo's light with Blinn's specular term, clipped to 1."""
    for i in vertices:
        out = attributes[i]
        row = surfaces.row[i]
        pose, colour = table[row], table[row, 3]
        specular, shininess, emission = table[row, 4, 0], table[row, 4, 1], table[row, 4, 2]
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        px = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3]
        py = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3]
        pz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3]
        x, y, z = surfaces.normal[i, 0], surfaces.normal[i, 1], surfaces.normal[i, 2]
        nx = pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z
        ny = pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z
        nz = pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z
        scale = _1 / math.sqrt(max(nx * nx + ny * ny + nz * nz, _TINY))
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        vx, vy, vz = eye[0] - px, eye[1] - py, eye[2] - pz
        scale = _1 / math.sqrt(max(vx * vx + vy * vy + vz * vz, _TINY))
        vx, vy, vz = vx * scale, vy * scale, vz * scale
        for c in range(3):
            out[c] = emission * colour[c]
        for n in range(lights.to.shape[0]):
            lx, ly, lz, strength = lights.to[n, 0], lights.to[n, 1], lights.to[n, 2], _1
            if lights.placed[n]:
                lx, ly, lz = lx - px, ly - py, lz - pz
                distance = math.sqrt(max(lx * lx + ly * ly + lz * lz, _TINY))
                lx, ly, lz = lx / distance, ly / distance, lz / distance
                along = -(lx * lights.axis[n, 0] + ly * lights.axis[n, 1] + lz * lights.axis[n, 2])
                if lights.cone[n, 0] > np.float32(-1):
                    strength = np.float32(_power(along, lights.cone[n, 1])) if along >= lights.cone[n, 0] else _0
                fading = lights.attenuation[n, 0] + distance * (
                    lights.attenuation[n, 1] + distance * lights.attenuation[n, 2]
                )
                strength /= fading
            for c in range(3):
                out[c] += strength * lights.ambient[n, c] * colour[c]
            facing = nx * lx + ny * ly + nz * lz
            if facing <= _0 or strength <= _0:
                continue
            hx, hy, hz = lx + vx, ly + vy, lz + vz
            glint = _0
            if specular > _0:
                towards = (nx * hx + ny * hy + nz * hz) / math.sqrt(max(hx * hx + hy * hy + hz * hz, _TINY))
                glint = np.float32(_power(min(towards, _1), max(shininess, _0))) * specular
            for c in range(3):
                part = facing * lights.diffuse[n, c] * colour[c] + glint * lights.specular[n, c]
                out[c] += strength * part
        for c in range(3):
            out[c] = min(out[c], _1)
        out[3], out[4] = surfaces.uv[i, 0], surfaces.uv[i, 1]


@compiled
def _set_up(listed: Any, corners: Any, clip: Any, width: Any, height: Any, attributes: Any, planes: Any) -> None:
    """Compute the plane equations of attributes divided by distance, and of the inverse distance, over the image.

    Args:
        listed: (S,) triangles.
        corners: (T, 3).
        clip, width, height: see `geometry.draw_triangles`.
        attributes: attributes of the vertices.
        planes: (S, ATTRIBUTES + 1, 3), overwritten: change per pixel to the right, per pixel down, value at the first
            pixel.
    """
    half_width, half_height = 0.5 * width, 0.5 * height
    for slot in range(listed.size):
        i, j, k = corners[listed[slot], 0], corners[listed[slot], 1], corners[listed[slot], 2]
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
    coarsest = np.float32(_log2(float(side))) - np.float32(0.001)
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
