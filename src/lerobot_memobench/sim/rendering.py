"""Render frames: renderers, and the renderer cache of each thread."""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol, cast

import mujoco

from lerobot_memobench.errors import MemobenchError, nearest
from mujoco_raster.drawlist import DrawList, Image
from mujoco_raster.errors import RasterError
from mujoco_raster.highlights import Highlight

if TYPE_CHECKING:
    from mujoco_raster.rasterizer import Rasterizer


DEFAULT, HIGH = "default", "high"
QUALITIES = (DEFAULT, HIGH)
"""``high`` is for figures and videos: a pixel is the mean of four, at four times the cost."""


@dataclass(frozen=True)
class RenderSettings:
    """Size and quality of frames; see `QUALITIES`."""

    height: int = 256
    width: int = 256
    quality: str = DEFAULT

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
        from mujoco_raster.rasterizer import mean_of_four

        return mean_of_four(self.renderer.draw(model, data, camera, highlights))


CACHED_RENDERERS = 4
"""Renderers cached per thread; each holds textures and backgrounds of its scene, some 40 MB."""


class _RendererCache(threading.local):
    """Renderers of a thread; a renderer serves one thread at a time."""

    def __init__(self) -> None:
        self.renderers: OrderedDict[tuple[Any, RenderSettings], Renderer] = OrderedDict()


_cache = _RendererCache()


def get_renderer(key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList) -> Renderer:
    """Return this thread's renderer of a scene, created on first use and shared by simulations of the scene.

    Args:
        key: cache key of the scene.
        model: compiled scene.
        settings: size and quality of frames.
        draw_list: triangles to draw.
    """
    renderers = _cache.renderers
    full = (key, settings)
    if full not in renderers:
        while len(renderers) >= CACHED_RENDERERS:
            renderers.popitem(last=False)
        renderers[full] = make_renderer(model, settings, draw_list)
    renderers.move_to_end(full)
    return renderers[full]


def get_rasterizer(key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList) -> Rasterizer:
    """Return this thread's renderer of a scene that also maps pixels to geoms.

    It is the renderer of `get_renderer`, except for the quality ``high``, which uses a separate one of equal size.
    """
    return cast("Rasterizer", get_renderer(key, model, replace(settings, quality=DEFAULT), draw_list))


@contextlib.contextmanager
def translate_errors() -> Iterator[None]:
    """Raise errors of the rasterizer as `MemobenchError`."""
    try:
        yield
    except RasterError as error:
        raise MemobenchError(str(error)) from error


def make_renderer(model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList) -> Renderer:
    """Return a new renderer of a scene; arguments as in `get_renderer`."""
    from mujoco_raster.rasterizer import Rasterizer  # loads numba

    if settings.quality == HIGH:
        return Supersampled(Rasterizer(model, draw_list, 2 * settings.width, 2 * settings.height))
    return Rasterizer(model, draw_list, settings.width, settings.height)
