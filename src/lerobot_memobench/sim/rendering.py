"""Offscreen rendering: one GL context and one upload of meshes and textures per scene and process."""

from __future__ import annotations

import ctypes.util
import os
from collections import OrderedDict
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError, nearest

Image = NDArray[np.uint8]

BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}
"""MuJoCo's headless backends and the system library each needs."""


@dataclass(frozen=True)
class RenderSettings:
    """What a frame costs and shows.

    ``fast`` leaves out shadows, ``default`` has them, ``high`` adds 4× multisampling.
    """

    height: int = 256
    width: int = 256
    quality: str = "default"

    def __post_init__(self) -> None:
        if self.quality not in QUALITIES:
            raise MemobenchError(
                f"render quality {self.quality!r} is unknown; {nearest(self.quality, QUALITIES)}"
            )


QUALITIES = {"fast": (0, False), "default": (0, True), "high": (4, True)}
"""Per quality: MSAA samples and shadows."""
SHADOW_MAP = 1024


def gl_backend() -> str:
    """Return the backend to render with: ``MUJOCO_GL`` where set, else the first whose library is installed.

    Raises:
        MemobenchError: when no usable library is there.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in ("glfw",):
        return wanted
    if wanted and wanted not in BACKENDS:
        raise MemobenchError(f"MUJOCO_GL is {wanted!r}; for rendering without a display set it to egl or osmesa")
    for name in [wanted] if wanted else list(BACKENDS):
        if ctypes.util.find_library(BACKENDS[name]):
            return name
    missing = BACKENDS[wanted] if wanted else "EGL and OSMesa"
    raise MemobenchError(
        f"no GL library to render with ({missing} not found): run `make setup` as root, or install the Debian packages "
        "libegl1, libgl1-mesa-dri and libosmesa6"
    )


def _gl_context(width: int, height: int) -> Any:
    backend = gl_backend()
    os.environ["MUJOCO_GL"] = backend
    try:
        if backend == "egl":
            from mujoco.egl import GLContext
        elif backend == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.glfw import GLContext
        return GLContext(width, height)
    except Exception as error:  # each backend fails in its own way: missing driver, no device, no display
        other = "osmesa" if backend == "egl" else "egl"
        raise MemobenchError(
            f"the GL backend {backend!r} could not open a context ({error}); try MUJOCO_GL={other}, and see `memobench doctor`"
        ) from error


@dataclass(frozen=True)
class Highlight:
    """A translucent disc drawn over the scene: the prompt's way of marking a place."""

    position: tuple[float, float, float]
    radius: float
    rgba: tuple[float, float, float, float] = (1.0, 0.85, 0.1, 0.55)


class Renderer:
    """Draw any simulation of one scene.

    Simulations of the same scene share it: meshes and textures are the scene's, poses come with each frame's data.
    """

    def __init__(self, model: mujoco.MjModel, settings: RenderSettings) -> None:
        samples, shadows = QUALITIES[settings.quality]
        model.vis.quality.offsamples = samples
        model.vis.quality.shadowsize = SHADOW_MAP
        model.vis.global_.offwidth, model.vis.global_.offheight = settings.width, settings.height
        self._settings = settings
        self._gl = _gl_context(settings.width, settings.height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 64)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 0
        self._option.geomgroup[1] = 1  # visual geoms only
        self._option.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._perturb = mujoco.MjvPerturb()
        self._viewport = mujoco.MjrRect(0, 0, settings.width, settings.height)

    def render(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: str,
        highlights: tuple[Highlight, ...] = (),
    ) -> Image:
        """Return the frame of a named camera, (height, width, 3) uint8, upright."""
        self._camera.fixedcamid = model.camera(camera).id
        self._gl.make_current()
        mujoco.mjv_updateScene(
            model, data, self._option, self._perturb, self._camera, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        for highlight in highlights:
            geom = self._scene.geoms[self._scene.ngeom]
            mujoco.mjv_initGeom(
                geom,
                mujoco.mjtGeom.mjGEOM_CYLINDER.value,
                np.array([highlight.radius, highlight.radius, 0.001]),
                np.array(highlight.position),
                np.eye(3).ravel(),
                np.array(highlight.rgba, dtype=np.float32),
            )
            self._scene.ngeom += 1
        image = np.empty((self._settings.height, self._settings.width, 3), dtype=np.uint8)
        mujoco.mjr_render(self._viewport, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, self._viewport, self._context)
        return image[::-1].copy()

    def close(self) -> None:
        """Free the GL context; safe to call twice."""
        if self._gl is not None:
            self._gl.make_current()
            self._context.free()
            self._gl.free()
            self._gl = None


_renderers: OrderedDict[tuple[Any, RenderSettings], Renderer] = OrderedDict()
CACHED_RENDERERS = 2


def get_renderer(key: Any, model: mujoco.MjModel, settings: RenderSettings) -> Renderer:
    """Return this process's renderer for a scene, opened at its first frame."""
    full = (key, settings)
    if full not in _renderers:
        while len(_renderers) >= CACHED_RENDERERS:
            _renderers.popitem(last=False)[1].close()
        _renderers[full] = Renderer(model, settings)
    _renderers.move_to_end(full)
    return _renderers[full]
