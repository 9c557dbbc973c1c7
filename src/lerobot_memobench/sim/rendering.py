"""Render frames: qualities, renderers, and the renderer cache of each thread."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING, Any, Protocol, cast

import mujoco
import numpy as np

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.sim.raster.drawlist import DrawList, Image, build_draw_list
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.raster.shapes import Triangles, mesh_in_file
from lerobot_memobench.sim.robot import whole_arm

if TYPE_CHECKING:
    from lerobot_memobench.sim.raster.rasterizer import Rasterizer


@dataclass(frozen=True)
class Quality:
    """Render settings of a quality level.

    Attributes:
        shadow_map: side of the shadow map, pixels; 0 disables shadows.
        smooth: whether a pixel is the mean of four.
        whole_arm: whether the arm is drawn with its original meshes.
    """

    shadow_map: int
    smooth: bool = False
    whole_arm: bool = False


QUALITIES = {"fast": Quality(0), "default": Quality(1024), "high": Quality(2048, smooth=True, whole_arm=True)}
"""Textures and lights are equal. ``fast`` omits shadows. ``high`` is for figures and videos: smooth edges, sharper
shadows and the original arm meshes, at ten times the cost."""

SHADOWLESS_BODIES = ("room", "kitchen_table")
"""Bodies that cast no shadow because no other body is below or behind them."""


@dataclass(frozen=True)
class RenderSettings:
    """Size and quality of frames; see `QUALITIES`."""

    height: int = 256
    width: int = 256
    quality: str = "default"

    def __post_init__(self) -> None:
        if self.quality not in QUALITIES:
            raise MemobenchError(f"render quality {self.quality!r} is unknown; {nearest(self.quality, QUALITIES)}")
        if self.height < 1 or self.width < 1:
            raise MemobenchError(f"frames of {self.height}×{self.width} pixels cannot be drawn; use sizes of 1 or more")


class Renderer(Protocol):
    """Draws frames of a scene at one size and quality."""

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return a camera's image, (height, width, 3) uint8, first row on top."""
        ...


@dataclass(frozen=True)
class Supersampled:
    """Draw frames at twice the width and height, and average four pixels."""

    renderer: Rasterizer

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return a camera's image; see `Renderer`."""
        fine = self.renderer.draw(model, data, camera, highlights)
        height, width, channels = fine.shape
        total = fine.reshape(height // 2, 2, width // 2, 2, channels).sum(axis=(1, 3), dtype=np.uint16)
        return ((total + 2) // 4).astype(np.uint8)


CACHED_RENDERERS = 4
"""Renderers cached per thread; each holds textures and backgrounds of its scene, some 40 MB."""


class _RendererCache(threading.local):
    """Renderers of a thread; a renderer serves one thread at a time."""

    def __init__(self) -> None:
        self.renderers: OrderedDict[tuple[Any, RenderSettings], Renderer] = OrderedDict()


_cache = _RendererCache()


def get_renderer(
    key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None
) -> Renderer:
    """Return this thread's renderer of a scene, created on first use and shared by simulations of the scene.

    Args:
        key: cache key of the scene.
        model: compiled scene.
        settings: size and quality of frames.
        draw_list: triangles to draw; by default all visual geoms of the model.
    """
    renderers = _cache.renderers
    full = (key, settings)
    if full not in renderers:
        while len(renderers) >= CACHED_RENDERERS:
            renderers.popitem(last=False)
        renderers[full] = make_renderer(model, settings, draw_list)
    renderers.move_to_end(full)
    return renderers[full]


def get_rasterizer(
    key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None
) -> Rasterizer:
    """Return this thread's renderer of a scene that also maps pixels to geoms.

    It is the renderer of `get_renderer`, except for supersampled qualities, which use a separate one of equal size.
    """
    settings = replace(settings, quality="fast") if QUALITIES[settings.quality].smooth else settings
    return cast("Rasterizer", get_renderer(key, model, settings, draw_list))


def make_renderer(model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None) -> Renderer:
    """Return a new renderer of a scene; arguments as in `get_renderer`."""
    quality = QUALITIES[settings.quality]
    if draw_list is None:
        draw_list = build_draw_list(model, SHADOWLESS_BODIES, _whole_arm_meshes() if quality.whole_arm else None)
    from lerobot_memobench.sim.raster.rasterizer import Rasterizer  # loads numba

    fine = 2 if quality.smooth else 1
    rasterizer = Rasterizer(model, draw_list, fine * settings.width, fine * settings.height, quality.shadow_map)
    return Supersampled(rasterizer) if quality.smooth else rasterizer


@cache
def _whole_arm_meshes() -> dict[str, Triangles]:
    """Return the original meshes of the arm by name."""
    arm = whole_arm()
    return {arm.mesh(mesh).name: mesh_in_file(arm, mesh) for mesh in range(arm.nmesh)}
