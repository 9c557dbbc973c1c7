"""Update the cached image of static rows: only shadows of moving rows change it."""

from __future__ import annotations

from typing import Any

import numpy as np

from lerobot_memobench.sim.raster.compiled import compiled
from lerobot_memobench.sim.raster.geometry import TILE

BACKGROUND_CHANNELS = 9
"""Values per background pixel: unshadowed colour (3), colour removed by shadow (3), position in the shadow map (3)."""

_0, _1, _HALF, _255 = np.float32(0), np.float32(1), np.float32(0.5), np.float32(255)


@compiled
def shadow_tiles(kept: Any, size: Any, tiles: Any, tile: Any) -> None:
    """Compute the shadow-map tile of each background pixel.

    Args:
        kept: (BACKGROUND_CHANNELS, pixels).
        size: side of the shadow map, texels.
        tiles: tiles per side; pixels that no shadow can change get the index after the last tile.
        tile: (pixels,), overwritten.
    """
    wide, last = np.float32(size), np.float32(size - 2)
    for p in range(tile.size):
        if kept[3, p] > _0 or kept[4, p] > _0 or kept[5, p] > _0:
            left = int(min(max(kept[6, p] * wide - _HALF, _0), last))
            top = int(min(max(kept[7, p] * wide - _HALF, _0), last))
            tile[p] = top // TILE * tiles + left // TILE
        else:
            tile[p] = tiles * tiles


@compiled
def light_background(kept: Any, tile: Any, touched: Any, triangle: Any, shadow_map: Any, image: Any) -> None:
    """Recolour the background pixels whose shadow-map tile was touched.

    Args:
        kept: (BACKGROUND_CHANNELS, pixels).
        tile: see `shadow_tiles`.
        touched: flag per tile, and one more for pixels that no shadow can change.
        triangle: (pixels,), −1 where the background is visible.
        shadow_map: (size, size).
        image: (pixels, 3) uint8, updated.
    """
    size = shadow_map.shape[0]
    wide, last = np.float32(size), np.float32(size - 2)
    for k in range(tile.size):
        if not touched[tile[k]] or triangle[k] >= 0:
            continue
        a = min(max(kept[6, k] * wide - _HALF, _0), last)
        b = min(max(kept[7, k] * wide - _HALF, _0), last)
        left, top = np.int32(a), np.int32(b)
        across, down, depth = a - np.float32(left), b - np.float32(top), kept[8, k]
        p = _1 if depth <= shadow_map[top, left] else _0
        q = _1 if depth <= shadow_map[top, left + 1] else _0
        r = _1 if depth <= shadow_map[top + 1, left] else _0
        s = _1 if depth <= shadow_map[top + 1, left + 1] else _0
        upper, lower = p + across * (q - p), r + across * (s - r)
        u, v = kept[6, k], kept[7, k]
        lit = _1 if min(u, _1 - u, v, _1 - v) < _0 else upper + down * (lower - upper)
        for c in range(3):
            colour = kept[c, k] + lit * kept[3 + c, k]
            image[k, c] = np.uint8(min(max(colour, _0), _255) + _HALF)
