"""Rendering: qualities of frames, what draws them, and the renderers that a thread keeps."""

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
from lerobot_memobench.sim.gl.context import close_context
from lerobot_memobench.sim.raster.drawlist import DrawList, Image, build_draw_list
from lerobot_memobench.sim.raster.highlights import Highlight
from lerobot_memobench.sim.raster.shapes import Triangles, mesh_in_file
from lerobot_memobench.sim.robot import whole_arm

if TYPE_CHECKING:
    from lerobot_memobench.sim.raster.rasterizer import Rasterizer


@dataclass(frozen=True)
class Quality:
    """What a frame is drawn with.

    ``shadow_map``: its side in pixels; 0 leaves shadows out. ``samples``: per pixel, by OpenGL; 0 is one in its middle,
    drawn on the CPU without GL. ``whole_arm``: the arm's meshes with all their faces, not thinned.
    """

    shadow_map: int
    samples: int = 0
    whole_arm: bool = False


QUALITIES = {"fast": Quality(0), "default": Quality(1024), "high": Quality(2048, samples=4, whole_arm=True)}
"""Textures and light are the same in all. ``fast`` leaves out shadows. ``high`` is for pictures and videos: it smooths
edges, sharpens shadows and draws the arm whole. It alone needs a GL library, and costs ten times as much.
Scenes that are drawn as by MuJoCo need none for ``high`` either."""

ROOM = ("room", "kitchen_table")
"""Bodies that cast no shadow: what theirs would fall on is under or behind them."""


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
            raise MemobenchError(f"frames of {self.height}×{self.width} pixels cannot be drawn; both must be 1 or more")

    @property
    def needs_gl(self) -> bool:
        """Whether frames are drawn by OpenGL."""
        return QUALITIES[self.quality].samples > 0


class Renderer(Protocol):
    """What draws the frames of a scene at one size and quality."""

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return what a camera sees, (height, width, 3) uint8, first row on top."""
        ...

    def free(self) -> None:
        """Give back kept pictures, or the driver's objects."""
        ...


@dataclass(frozen=True)
class Supersampled:
    """Draw frames of twice the width and height, and take the mean of four pixels: smooth edges without GL."""

    renderer: Rasterizer

    def draw(
        self, model: mujoco.MjModel, data: mujoco.MjData, camera: str, highlights: Sequence[Highlight] = ()
    ) -> Image:
        """Return what a camera sees; see `Renderer`."""
        fine = self.renderer.draw(model, data, camera, highlights)
        height, width, channels = fine.shape
        total = fine.reshape(height // 2, 2, width // 2, 2, channels).sum(axis=(1, 3), dtype=np.uint16)
        return ((total + 2) // 4).astype(np.uint8)

    def free(self) -> None:
        """Give back kept pictures."""
        self.renderer.free()


CACHED_RENDERERS = 4
"""Renderers kept per thread: each holds its scene's textures and background, some 40 MB."""


class _Thread(threading.local):
    """The renderers of a thread; each serves one thread at a time."""

    def __init__(self) -> None:
        self.renderers: OrderedDict[tuple[Any, RenderSettings], Renderer] = OrderedDict()


_thread = _Thread()


def get_renderer(
    key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None
) -> Renderer:
    """Return this thread's renderer for a scene, made at its first frame.

    Simulations of the same scene share it: meshes and textures are the scene's, poses come with each frame's data.

    Args:
        key: the scene's name.
        model: a compiled scene.
        settings: size and quality of frames.
        draw_list: what there is to draw, where it is not all visual geoms of the model.
    """
    renderers = _thread.renderers
    full = (key, settings)
    if full not in renderers:
        while len(renderers) >= CACHED_RENDERERS:
            renderers.popitem(last=False)[1].free()
        renderers[full] = make_renderer(model, settings, draw_list)
    renderers.move_to_end(full)
    return renderers[full]


def get_rasterizer(
    key: Any, model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None
) -> Rasterizer:
    """Return this thread's renderer for a scene that also maps pixels to geoms.

    It is the one of `get_renderer`; where GL draws the frames, one of the same size.
    """
    settings = replace(settings, quality="fast") if settings.needs_gl else settings
    return cast("Rasterizer", get_renderer(key, model, settings, draw_list))


def make_renderer(model: mujoco.MjModel, settings: RenderSettings, draw_list: DrawList | None = None) -> Renderer:
    """Return a renderer of one's own for a scene, to be freed by `Renderer.free`; see `get_renderer`."""
    quality, size = QUALITIES[settings.quality], (settings.width, settings.height)
    if draw_list is None:
        draw_list = build_draw_list(model, ROOM, _whole_arm_meshes() if quality.whole_arm else None)
    # PyOpenGL and numba are loaded with the first frame.
    if settings.needs_gl and not draw_list.as_mujoco:
        from lerobot_memobench.sim.gl.rasterizer import MultisampleRasterizer

        return MultisampleRasterizer(model, draw_list, *size, quality.samples, quality.shadow_map)
    from lerobot_memobench.sim.raster.rasterizer import Rasterizer

    if settings.needs_gl:
        return Supersampled(Rasterizer(model, draw_list, 2 * settings.width, 2 * settings.height, 0))
    return Rasterizer(model, draw_list, *size, quality.shadow_map)


@cache
def _whole_arm_meshes() -> dict[str, Triangles]:
    """Return the meshes of the whole arm by name."""
    arm = whole_arm()
    return {arm.mesh(mesh).name: mesh_in_file(arm, mesh) for mesh in range(arm.nmesh)}


def close_renderers() -> None:
    """Free the calling thread's renderers and GL context; the next frame makes new ones.

    A thread that has drawn with `high` calls this before it ends; for the main thread it happens at exit.
    """
    while _thread.renderers:
        _thread.renderers.popitem()[1].free()
    close_context()
