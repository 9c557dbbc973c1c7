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


class Shapes(NamedTuple):
    """Triangles of a scene by rows of the table, constant over frames.

    ``position``: (N, 3) in the frames of the rows; ``first_vertex``: (rows + 1,), and ``first_triangle`` likewise;
    ``triangles``: (T, 3); ``centre`` and ``half``: (rows, 3), the boxes around the rows in their frames.
    """

    position: Floats
    first_vertex: Integers
    triangles: Integers
    first_triangle: Integers
    centre: Floats
    half: Floats


class Clip(NamedTuple):
    """Vertices in the clip space of a camera, (N,) each; ``visible``: (rows,)."""

    x: Floats
    y: Floats
    w: Floats
    visible: NDArray[np.bool_]


class Target(NamedTuple):
    """Image buffers: ``depth`` (H, W), inverse distance, 0 at infinity; ``triangle`` (H, W), −1 for none."""

    depth: Floats
    triangle: Integers


def clip_space(vertices: int, rows: int) -> Clip:
    """Return buffers for the vertices of a scene."""
    x, y, w = (np.zeros(vertices, np.float32) for _ in range(3))
    return Clip(x, y, w, np.zeros(rows, np.bool_))


@compiled
def _project(shapes: Any, rows: Any, table: Any, matrix: Any, near: Any, clip: Any) -> None:
    """Transform the vertices of rows to clip space; skip rows outside the image.

    Args:
        shapes: `Shapes`.
        rows: indices of rows.
        table: poses, (all rows, TABLE_LINES, 4).
        matrix: from the world to clip space, (4, 4).
        near: distance of the near clipping plane, m.
        clip: `Clip`, overwritten.
    """
    m = np.empty((3, 4), np.float32)
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
        for i in range(shapes.first_vertex[row], shapes.first_vertex[row + 1]):
            x, y, z = shapes.position[i, 0], shapes.position[i, 1], shapes.position[i, 2]
            clip.x[i] = a * x + b * y + c * z + d
            clip.y[i] = e * x + f * y + g * z + h
            clip.w[i] = p * x + q * y + r * z + s


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
    _project(shapes, rows, table, matrix, near, clip)
    height, width = target.depth.shape
    nearest, farthest = np.float32(1) / near, np.float32(1) / far
    half_width, half_height = 0.5 * width, 0.5 * height
    depths, shown = target.depth.reshape(-1), target.triangle.reshape(-1)
    for row in rows:
        if not clip.visible[row]:
            continue
        for t in range(shapes.first_triangle[row], shapes.first_triangle[row + 1]):
            i, j, k = shapes.triangles[t, 0], shapes.triangles[t, 1], shapes.triangles[t, 2]
            xi, yi, wi = clip.x[i], clip.y[i], clip.w[i]
            xj, yj, wj = clip.x[j], clip.y[j], clip.w[j]
            xk, yk, wk = clip.x[k], clip.y[k], clip.w[k]
            # Most triangles of a large row lie beyond one side of the image.
            if (xi > wi and xj > wj and xk > wk) or (xi < -wi and xj < -wj and xk < -wk):
                continue
            if (yi > wi and yj > wj and yk > wk) or (yi < -wi and yj < -wj and yk < -wk):
                continue
            w0, w1, w2 = float(wi), float(wj), float(wk)
            x0, y0 = (xi + w0) * half_width, (yi + w0) * half_height
            x1, y1 = (xj + w1) * half_width, (yj + w1) * half_height
            x2, y2 = (xk + w2) * half_width, (yk + w2) * half_height
            # Barycentric coefficients of a point (x, y, 1), not yet divided by the volume spanned by the corners.
            a0, b0, c0 = y2 * w1 - y1 * w2, x1 * w2 - x2 * w1, x2 * y1 - x1 * y2
            volume = a0 * x0 + b0 * y0 + c0 * w0
            if volume <= 1e-12:
                continue
            left, right, top, bottom = 0, width - 1, 0, height - 1
            behind = w0 <= 1e-6 or w1 <= 1e-6 or w2 <= 1e-6  # a corner behind the camera: no bounding box in the image
            if not behind:
                u0, u1, u2 = x0 / w0, x1 / w1, x2 / w2
                v0, v1, v2 = y0 / w0, y1 / w1, y2 / w2
                low, high = min(u0, u1, u2) - 0.5, max(u0, u1, u2) - 0.5
                if high < 0.0 or low > right:
                    continue
                left, right = math.ceil(max(low, 0.0)), int(min(high, float(right)))
                low, high = min(v0, v1, v2) - 0.5, max(v0, v1, v2) - 0.5
                if high < 0.0 or low > bottom:
                    continue
                top, bottom = math.ceil(max(low, 0.0)), int(min(high, float(bottom)))
                if left > right or top > bottom:
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
