"""Rasterize triangles: cull rows, and find the nearest triangle of each pixel."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mujoco_raster.compiled import compiled

Floats = NDArray[np.float32]
Integers = NDArray[np.int32]

LEVEL_EDGE_SLOPE = 1e-9
"""Relative slope below which an edge counts as horizontal."""
BEHIND = 1e-6
"""Largest distance along the optical axis at which a position counts as behind the camera, m."""
LIMIT = 32767.0
"""Largest column and row of a position, pixels; images are smaller."""
ROUNDING = np.float32(4e-6)
"""Bound of the rounding of projected positions, as a share of distances; some ten times as large."""


class Shapes(NamedTuple):
    """Triangles of a scene by rows of the table, constant over frames.

    A vertex is a position with a normal and texture coordinates; a position of several vertices is stored once.
    ``triangles``: (T, 3) vertices; ``corners``: (T, 3) their positions; ``position``: (3, P) in the frames of the rows;
    ``first_point`` and ``first_triangle``: (rows + 1,); ``planes``: (4, T), see `set_planes`; ``centre`` and ``half``:
    (rows, 3), the boxes around the rows in their frames.
    """

    triangles: Integers
    corners: Integers
    position: Floats
    first_point: Integers
    first_triangle: Integers
    planes: Floats
    centre: Floats
    half: Floats


class Clip(NamedTuple):
    """A scene in the clip space of a camera: coordinates (P,); ``pixels`` (P, 4), see `_project`; visible rows (rows,);
    and triangles that may face the camera (T,).
    """

    x: Floats
    y: Floats
    w: Floats
    pixels: NDArray[np.int16]
    visible: NDArray[np.bool_]
    front: NDArray[np.bool_]


class Target(NamedTuple):
    """Image buffers: ``depth`` (H, W), inverse distance, 0 at infinity; ``triangle`` (H, W), −1 for none."""

    depth: Floats
    triangle: Integers


def clip_space(shapes: Shapes) -> Clip:
    """Return buffers for a scene."""
    points, rows = shapes.position.shape[1], len(shapes.centre)
    x, y, w = (np.zeros(points, np.float32) for _ in range(3))
    front = np.zeros(len(shapes.triangles), np.bool_)
    return Clip(x, y, w, np.zeros((points, 4), np.int16), np.zeros(rows, np.bool_), front)


@compiled
def set_planes(position: Any, corners: Any, planes: Any) -> None:
    """Compute the planes of triangles, (4, T): normals times the triangle's smallest height, and offsets.

    A point p is in front of a triangle if normal · p > offset. The orientation of a projected triangle is the less
    certain the smaller its height is; with this length of the normals one tolerance serves all triangles.
    """
    for t in range(corners.shape[0]):
        i, j, k = corners[t, 0], corners[t, 1], corners[t, 2]
        a, b, c = position[0, j] - position[0, i], position[1, j] - position[1, i], position[2, j] - position[2, i]
        d, e, f = position[0, k] - position[0, i], position[1, k] - position[1, i], position[2, k] - position[2, i]
        x, y, z = float(b * f - c * e), float(c * d - a * f), float(a * e - b * d)
        g, h, m = d - a, e - b, f - c
        longest = math.sqrt(max(a * a + b * b + c * c, d * d + e * e + f * f, g * g + h * h + m * m))
        scale = 1.0 / max(longest, 1e-30)
        planes[0, t], planes[1, t], planes[2, t] = x * scale, y * scale, z * scale
        planes[3, t] = (x * position[0, i] + y * position[1, i] + z * position[2, i]) * scale


@compiled
def _project(shapes: Any, rows: Any, table: Any, matrix: Any, near: Any, clip: Any, width: Any, height: Any) -> None:
    """Transform the positions of rows to clip space and find the pixels around them; skip rows outside the image.

    Args:
        shapes: `Shapes`.
        rows: indices of rows.
        table: poses, (all rows, TABLE_LINES, 4).
        matrix: from the world to clip space, (4, 4).
        near: distance of the near clipping plane, m.
        clip: `Clip`, overwritten. ``pixels``: first column and row with centres not before a position, and last ones
            with centres not after it; the whole image for a position behind the camera.
        width, height: size of the image, pixels.
    """
    m = np.empty((3, 4), np.float32)
    px, py, pz = shapes.position[0], shapes.position[1], shapes.position[2]
    nx, ny, nz, offset = shapes.planes[0], shapes.planes[1], shapes.planes[2], shapes.planes[3]
    half_width, half_height = 0.5 * width, 0.5 * height
    for row in rows:
        for k in range(3):
            line = k if k < 2 else 3  # depths are taken from w
            for j in range(4):
                total = matrix[line, 0] * table[row, 0, j] + matrix[line, 1] * table[row, 1, j]
                total += matrix[line, 2] * table[row, 2, j]
                m[k, j] = total + matrix[line, 3] if j == 3 else total
        clip.visible[row] = _in_image(m, shapes.centre[row], shapes.half[row], near)
        if not clip.visible[row]:
            continue
        a, b, c, d = m[0, 0], m[0, 1], m[0, 2], m[0, 3]
        e, f, g, h = m[1, 0], m[1, 1], m[1, 2], m[1, 3]
        p, q, r, s = m[2, 0], m[2, 1], m[2, 2], m[2, 3]
        first, last = np.uint64(shapes.first_point[row]), np.uint64(shapes.first_point[row + 1])
        for i in range(first, last):
            x, y, z = px[i], py[i], pz[i]
            clip.x[i] = a * x + b * y + c * z + d
            clip.y[i] = e * x + f * y + g * z + h
            clip.w[i] = p * x + q * y + r * z + s
        for i in range(first, last):
            depth = float(clip.w[i])
            ahead = depth > BEHIND
            u, v = (clip.x[i] + depth) * half_width / depth - 0.5, (clip.y[i] + depth) * half_height / depth - 0.5
            u, v = min(max(u, -LIMIT), LIMIT), min(max(v, -LIMIT), LIMIT)
            clip.pixels[i, 0] = np.int16(np.int32(math.ceil(u if ahead else -LIMIT)))
            clip.pixels[i, 1] = np.int16(np.int32(math.ceil(v if ahead else -LIMIT)))
            clip.pixels[i, 2] = np.int16(np.int32(math.floor(u if ahead else LIMIT)))
            clip.pixels[i, 3] = np.int16(np.int32(math.floor(v if ahead else LIMIT)))
        x, y, z = _eye(m)
        tolerance = np.float32(0)
        for value in (x, y, z, table[row, 0, 3], table[row, 1, 3], table[row, 2, 3]):
            tolerance += ROUNDING * abs(value)
        for t in range(np.uint64(shapes.first_triangle[row]), np.uint64(shapes.first_triangle[row + 1])):
            clip.front[t] = nx[t] * x + ny[t] * y + nz[t] * z - offset[t] >= -tolerance


@compiled
def _eye(m: Any) -> Any:
    """Return the position of the camera in a row's frame: all three lines of its matrix (3, 4) are 0 there."""
    a, b, c, d = float(m[0, 0]), float(m[0, 1]), float(m[0, 2]), float(m[0, 3])
    e, f, g, h = float(m[1, 0]), float(m[1, 1]), float(m[1, 2]), float(m[1, 3])
    p, q, r, s = float(m[2, 0]), float(m[2, 1]), float(m[2, 2]), float(m[2, 3])
    volume = -1.0 / (a * (f * r - g * q) + b * (g * p - e * r) + c * (e * q - f * p))
    x = (d * (f * r - g * q) + h * (c * q - b * r) + s * (b * g - c * f)) * volume
    y = (d * (g * p - e * r) + h * (a * r - c * p) + s * (c * e - a * g)) * volume
    z = (d * (e * q - f * p) + h * (b * p - a * q) + s * (a * f - b * e)) * volume
    return np.float32(x), np.float32(y), np.float32(z)


@compiled
def _in_image(m: Any, centre: Any, half: Any, near: Any) -> Any:
    """Return whether a box may be in the image: not entirely beyond one side of the view volume."""
    for side in range(5):
        axis = side // 2
        sign = np.float32(1 - 2 * (side % 2))
        inside = np.float32(0)
        for k in range(4):
            factor = m[2, k] + sign * m[axis, k] if side < 4 else m[2, k]
            inside += factor if k == 3 else factor * centre[k] + abs(factor) * half[k]
        if inside < (near if side == 4 else np.float32(0)):
            return False
    return True


@compiled
def _bounds(a: Any, b: Any, c: Any) -> Any:
    """Return (p, q, r, s): an edge with a x + b y + c ≥ 0 inside bounds x in row y by p y + q and r y + s.

    Horizontal edges bound the rows instead, see `_rows`.
    """
    if abs(a) <= LEVEL_EDGE_SLOPE * abs(b):
        return 0.0, -1e30, 0.0, 1e30
    slope, start = -b / a, -c / a
    return (slope, start, 0.0, 1e30) if a > 0.0 else (0.0, -1e30, slope, start)


@compiled
def _rows(top: Any, bottom: Any, a: Any, b: Any, c: Any) -> Any:
    """Return the first and last row within an edge; only horizontal edges restrict them."""
    if abs(a) > LEVEL_EDGE_SLOPE * abs(b):
        return top, bottom
    if b > 0.0:
        return max(top, math.ceil(min(max(-c / b, -1e6), 1e6))), bottom
    if b < 0.0:
        return top, min(bottom, math.floor(min(max(-c / b, -1e6), 1e6)))
    return top, bottom if c >= 0.0 else -1


@compiled
def _span(left: Any, right: Any, y: Any, edge0: Any, edge1: Any, edge2: Any) -> Any:
    """Return the first and last pixel of a row within three edges; last < first if there is none."""
    start = max(edge0[0] * y + edge0[1], edge1[0] * y + edge1[1], edge2[0] * y + edge2[1], float(left))
    end = min(edge0[2] * y + edge0[3], edge1[2] * y + edge1[3], edge2[2] * y + edge2[3], float(right))
    if start > end:
        return 0, -1
    first = int(start)
    return first + 1 if first < start else first, int(end)


@compiled
def draw_triangles(
    shapes: Any, rows: Any, table: Any, matrix: Any, near: Any, far: Any, clip: Any, target: Any
) -> None:
    """Update each pixel with the nearest triangle of some rows.

    Triangles are set up in homogeneous coordinates, so those that extend behind the camera need no clipping. Pixel
    centres are sampled. Front faces are clockwise because images are drawn upside down. The first of equally near
    triangles is kept.

    Args:
        shapes: `Shapes`.
        rows: indices of rows in drawing order.
        table, matrix, near, clip: see `_project`.
        far: distance of the far clipping plane, m.
        target: `Target`, updated.
    """
    height, width = target.depth.shape
    _project(shapes, rows, table, matrix, near, clip, width, height)
    nearest, farthest = np.float32(1) / near, np.float32(1) / far
    half_width, half_height = 0.5 * width, 0.5 * height
    depths, shown = target.depth.reshape(-1), target.triangle.reshape(-1)
    pixels = clip.pixels
    for row in rows:
        if not clip.visible[row]:
            continue
        for t in range(shapes.first_triangle[row], shapes.first_triangle[row + 1]):
            if not clip.front[t]:
                continue
            i, j, k = shapes.corners[t, 0], shapes.corners[t, 1], shapes.corners[t, 2]
            left, right = min(pixels[i, 0], pixels[j, 0], pixels[k, 0]), max(pixels[i, 2], pixels[j, 2], pixels[k, 2])
            top, bottom = min(pixels[i, 1], pixels[j, 1], pixels[k, 1]), max(pixels[i, 3], pixels[j, 3], pixels[k, 3])
            left, right, top, bottom = max(left, 0), min(right, width - 1), max(top, 0), min(bottom, height - 1)
            if left > right or top > bottom:  # outside the image, or between pixel centres
                continue
            xi, yi, wi = clip.x[i], clip.y[i], clip.w[i]
            xj, yj, wj = clip.x[j], clip.y[j], clip.w[j]
            xk, yk, wk = clip.x[k], clip.y[k], clip.w[k]
            w0, w1, w2 = float(wi), float(wj), float(wk)
            behind = w0 <= BEHIND or w1 <= BEHIND or w2 <= BEHIND
            if behind and (
                (xi > wi and xj > wj and xk > wk)
                or (xi < -wi and xj < -wj and xk < -wk)
                or (yi > wi and yj > wj and yk > wk)
                or (yi < -wi and yj < -wj and yk < -wk)
            ):
                continue
            x0, y0 = (xi + w0) * half_width, (yi + w0) * half_height
            x1, y1 = (xj + w1) * half_width, (yj + w1) * half_height
            x2, y2 = (xk + w2) * half_width, (yk + w2) * half_height
            # Barycentric coefficients of a point (x, y, 1), not yet divided by the volume spanned by the corners.
            a0, b0, c0 = y2 * w1 - y1 * w2, x1 * w2 - x2 * w1, x2 * y1 - x1 * y2
            volume = a0 * x0 + b0 * y0 + c0 * w0
            if volume <= 1e-12:
                continue
            a1, b1, c1 = y0 * w2 - y2 * w0, x2 * w0 - x0 * w2, x0 * y2 - x2 * y0
            a2, b2, c2 = y1 * w0 - y0 * w1, x0 * w1 - x1 * w0, x1 * y0 - x0 * y1
            # Sample pixel centres.
            c0, c1, c2 = c0 + 0.5 * (a0 + b0), c1 + 0.5 * (a1 + b1), c2 + 0.5 * (a2 + b2)
            if behind:
                top, bottom = _rows(top, bottom, a0, b0, c0)
                top, bottom = _rows(top, bottom, a1, b1, c1)
                top, bottom = _rows(top, bottom, a2, b2, c2)
            edge0, edge1, edge2 = _bounds(a0, b0, c0), _bounds(a1, b1, c1), _bounds(a2, b2, c2)
            scale = 0.0
            across, down, at_origin, slope = 0.0, 0.0, 0.0, np.float32(0)
            for y in range(top, bottom + 1):
                first, last = _span(left, right, y, edge0, edge1, edge2)
                if first > last:
                    continue
                if scale == 0.0:
                    scale = 1.0 / volume
                    across, down = (a0 + a1 + a2) * scale, (b0 + b1 + b2) * scale
                    at_origin, slope = (c0 + c1 + c2) * scale, np.float32(across)
                depth = np.float32(across * first + (down * y + at_origin))
                before = np.uint64(y * width + first)  # numba looks whether other indices are negative
                for step in range(last + 1 - first):
                    inverse = depth + slope * np.float32(step)
                    if depths[before + np.uint64(step)] < inverse <= nearest and inverse > farthest:
                        depths[before + np.uint64(step)] = inverse
                        shown[before + np.uint64(step)] = t
