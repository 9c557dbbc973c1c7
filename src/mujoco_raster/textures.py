"""Convert textures into layers of one size with mipmaps, and compute texture coordinates of shapes without them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mujoco_raster.compiled import compiled
from mujoco_raster.shapes import Triangles

LAYER_SIZE = 512
"""Side of a texture layer, pixels; a power of two, the largest size of this package's textures."""
LAYER_TEXELS = (4 * LAYER_SIZE**2 - 1) // 3  # pixels of a layer and of its mipmaps
SIDES = 6
"""Sides of a cube in OpenGL's order: +x, −x, +y, −y, +z, −z."""

_ACROSS = ((2, -1), (2, 1), (0, 1), (0, 1), (0, 1), (0, -1))
_DOWN = ((1, -1), (1, -1), (2, 1), (2, -1), (1, -1), (1, -1))
"""Axis and direction of the image on each side of a cube (OpenGL 2.1, table 3.21)."""


def layers_of(
    model: mujoco.MjModel, images: Mapping[str, NDArray[np.uint8]] | None = None, *, sky: bool = False
) -> tuple[NDArray[np.int32], dict[int, tuple[int, ...]]]:
    """Return the mipmaps of a model's textures at one size, and texture id → its layer (six for a cube).

    Args:
        model: compiled scene.
        images: replacements of the scene's textures by name, (height, width, 3).
        sky: whether to include the skybox.

    Returns:
        Layers from full size to one pixel, (L, `LAYER_TEXELS`), pixels as red + 256 green + 65536 blue; layer 0 is
        white.
    """
    layers: list[NDArray[np.uint8]] = [np.full((LAYER_SIZE, LAYER_SIZE, 3), 255, dtype=np.uint8)]
    layer_of: dict[int, tuple[int, ...]] = {}
    known: dict[bytes, int] = {}  # the sides of a cube often share an image
    for texture in range(model.ntex):
        if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_SKYBOX and not (sky and texture == skybox_of(model)):
            continue
        pixels = (images or {}).get(model.tex(texture).name)
        sides = _images(model, texture, pixels_of(model, texture) if pixels is None else pixels)
        for image in sides:
            if (content := image.tobytes()) not in known:
                known[content] = len(layers)
                layers.append(resized(image))
            layer_of[texture] = (*layer_of.get(texture, ()), known[content])
    texels = np.empty((len(layers), LAYER_TEXELS), np.int32)
    for layer, levels in zip(layers, texels, strict=True):
        _fill_levels(np.array(layer, order="C"), levels)
    return texels, layer_of


def skybox_of(model: mujoco.MjModel) -> int:
    """Return the texture id of a model's skybox, -1 without one."""
    return next((k for k in range(model.ntex) if model.tex_type[k] == mujoco.mjtTexture.mjTEXTURE_SKYBOX), -1)


def texture_of(model: mujoco.MjModel, material: int) -> int:
    """Return the id of a material's colour texture, -1 for none or without a material."""
    if material < 0:
        return -1
    roles = mujoco.mjtTextureRole.mjTEXROLE_RGB.value, mujoco.mjtTextureRole.mjTEXROLE_RGBA.value
    rgb, rgba = (int(model.mat_texid[material, role]) for role in roles)
    return rgb if rgb >= 0 else rgba


def pixels_of(model: mujoco.MjModel, texture: int) -> NDArray[np.uint8]:
    """Return the image (height, width, 3) of a texture; an alpha channel is left out, and grey repeated.

    MuJoCo's renderer converts flat textures that are marked as sRGB to linear values, which are darker, and no others.
    """
    shape = int(model.tex_height[texture]), int(model.tex_width[texture]), int(model.tex_nchannel[texture])
    start = int(model.tex_adr[texture])
    pixels: NDArray[np.uint8] = np.asarray(model.tex_data[start : start + math.prod(shape)]).reshape(shape)
    pixels = pixels[..., :3] if shape[2] >= 3 else pixels[..., [0, 0, 0]]
    flat = model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D
    if not flat or model.tex_colorspace[texture] != mujoco.mjtColorSpace.mjCOLORSPACE_SRGB.value:
        return pixels
    value = np.arange(256) / 255
    linear = np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)[pixels]


def resized(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image resized to the layer size."""
    if image.shape[:2] == (LAYER_SIZE, LAYER_SIZE):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((LAYER_SIZE, LAYER_SIZE), Image.Resampling.BICUBIC))


def _images(model: mujoco.MjModel, texture: int, pixels: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """Return the image of a flat texture, or the six images of a cube, which may be a single one repeated."""
    if model.tex_type[texture] == mujoco.mjtTexture.mjTEXTURE_2D:
        return [pixels]
    return [pixels] * SIDES if len(pixels) == pixels.shape[1] else np.split(pixels, SIDES)


@compiled
def _fill_levels(layer: Any, levels: Any) -> None:
    """Write the levels of an image in order of size; a pixel is the mean of four pixels of the previous level."""
    side, start = layer.shape[0], 0
    for y in range(side):
        for x in range(side):
            red, green, blue = layer[y, x, 0], layer[y, x, 1], layer[y, x, 2]
            levels[y * side + x] = np.int32(red) + np.int32(green) * 256 + np.int32(blue) * 65536
    while side > 1:
        end, half = start + side * side, side // 2
        for y in range(half):
            for x in range(half):
                upper = start + 2 * y * side + 2 * x
                lower = upper + side
                a, b, c, d = levels[upper], levels[upper + 1], levels[lower], levels[lower + 1]
                red_blue = (a & 0xFF00FF) + (b & 0xFF00FF) + (c & 0xFF00FF) + (d & 0xFF00FF) + 0x020002
                green = (a & 0xFF00) + (b & 0xFF00) + (c & 0xFF00) + (d & 0xFF00) + 0x0200
                levels[end + y * half + x] = (red_blue >> 2 & 0xFF00FF) + (green >> 2 & 0xFF00)
        side, start = half, end


def _full_size(model: mujoco.MjModel, geom: int) -> NDArray[np.float64]:
    """Return the half extents (3,) by which MuJoCo's renderer scales a geom."""
    size = np.array(model.geom_size[geom])
    match mujoco.mjtGeom(int(model.geom_type[geom])):
        case mujoco.mjtGeom.mjGEOM_SPHERE:
            return size[[0, 0, 0]]
        case mujoco.mjtGeom.mjGEOM_CYLINDER | mujoco.mjtGeom.mjGEOM_CAPSULE:
            return size[[0, 0, 1]]
    return size


def flat_coordinates(model: mujoco.MjModel, geom: int, shape: Triangles) -> Triangles:
    """Project a texture from above as MuJoCo: repeated ``texrepeat`` times, or per 2 m if uniform."""
    points, normals, _, triangles = shape
    material = int(model.geom_matid[geom])
    scale = np.array(model.mat_texrepeat[material], dtype=np.float64)
    size = _full_size(model, geom)[:2]
    if not model.mat_texuniform[material]:
        scale = np.where(size > 0, scale / np.where(size > 0, size, 1.0), scale)
    uv = 0.5 * points[:, :2] * scale * [1.0, -1.0] - 0.5
    return points, normals, uv, triangles


def cube_coordinates(model: mujoco.MjModel, geom: int, shape: Triangles) -> Iterator[tuple[int, Triangles]]:
    """Yield each visible side of a cube texture and its triangles.

    A triangle belongs to the side in the direction of its centroid.
    """
    points, normals, _, triangles = shape
    direction = np.asarray(points, dtype=np.float64)
    if not model.mat_texuniform[int(model.geom_matid[geom])]:
        direction = direction / np.maximum(_full_size(model, geom), 1e-9)
    middle = direction[triangles].mean(axis=1)
    axis = np.abs(middle).argmax(axis=1)
    shown = 2 * axis + (np.take_along_axis(middle, axis[:, None], axis=1)[:, 0] < 0)
    for side in np.unique(shown):
        mine, index = np.unique(triangles[shown == side], return_inverse=True)
        there = direction[mine]
        depth = np.maximum(np.abs(there[:, side // 2]), 1e-9)
        uv = [0.5 * sign * there[:, k] / depth + 0.5 for k, sign in (_ACROSS[side], _DOWN[side])]
        # Do not wrap at the cube's edges.
        inside = np.clip(np.stack(uv, axis=1), 0.5 / LAYER_SIZE, 1 - 0.5 / LAYER_SIZE)
        yield int(side), (points[mine], normals[mine], inside, index.reshape(-1, 3))


def sky_box(side: int) -> Triangles:
    """Return one side of the sky, a cube of half size 1 seen from inside, in the world's axes.

    MuJoCo's skyboxes have y up: their axes x, y, z are the world's x, z, −y.
    """
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], dtype=np.float64)
    corners = np.empty((4, 3))
    corners[:, side // 2] = 1 - 2 * (side % 2)
    for (axis, sign), coordinate in zip((_ACROSS[side], _DOWN[side]), square.T, strict=True):
        corners[:, axis] = sign * (2 * coordinate - 1)
    points = corners[:, [0, 2, 1]] * [1, -1, 1]
    outward = np.cross(points[1] - points[0], points[2] - points[0]) @ points[0] > 0
    triangles = np.array([(0, 2, 1), (0, 3, 2)] if outward else [(0, 1, 2), (0, 2, 3)])
    # Do not wrap at the cube's edges.
    uv = np.clip(square, 0.5 / LAYER_SIZE, 1 - 0.5 / LAYER_SIZE)
    return points, -points / math.sqrt(3), uv, triangles
