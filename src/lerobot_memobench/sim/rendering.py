"""Offscreen rendering: qualities, GL backends, and one context per thread that all its renderers share."""

from __future__ import annotations

import atexit
import ctypes
import ctypes.util
import os
import threading
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco

from lerobot_memobench.errors import MemobenchError, nearest, unsupported_system
from lerobot_memobench.sim.gl.drawlist import build_draw_list
from lerobot_memobench.sim.gl.rasterizer import Rasterizer
from lerobot_memobench.sim.robot import whole_arm

BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}
"""MuJoCo's headless backends and the system library each needs."""

CONTEXT_SIZE = (64, 64)
DEVICE_ID = "MUJOCO_EGL_DEVICE_ID"
"""MuJoCo's variable for EGL's number of the device to draw on; a user's own choice stays."""
RANKS = ("MEMOBENCH_WORKER", "LOCAL_RANK", "SLURM_LOCALID", "OMPI_COMM_WORLD_LOCAL_RANK")
"""Variables that may tell the rank of a process on its node: a worker of ours, or a launcher of ranks."""
CUDA_DEVICE = 0x323A
"""EGL_CUDA_DEVICE_NV: CUDA's number of an EGL device."""


@dataclass(frozen=True)
class Quality:
    """What a frame is drawn with.

    ``samples``: samples per pixel; 0 is one, without multisampling. ``shadow_map``: its side in pixels; 0 leaves
    shadows out. ``whole_arm``: the arm's meshes with all their faces, not thinned.
    """

    samples: int
    shadow_map: int
    whole_arm: bool = False


QUALITIES = {"fast": Quality(0, 0), "default": Quality(0, 1024), "high": Quality(4, 2048, whole_arm=True)}
"""Textures and light are the same in all. ``fast`` leaves out shadows. ``high`` is for pictures and films: it smooths
edges, sharpens shadows and draws the arm whole. In software `fast` costs about 0.6 of `default` and `high` ten times as
much."""

ROOM = ("room", "kitchen_table")
"""Bodies that cast no shadow: what theirs would fall on is under or behind them."""

BACKGROUND = ("kitchen_table", "mount0_torso", "mount0_pedestal", "robot0_link0", "room")
"""Bodies that stand behind others, nearest first: drawn last in this order, most of their pixels are taken already."""


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


def gl_backend() -> str:
    """Return the backend to render with: ``MUJOCO_GL`` where set, else the first whose library is installed.

    Raises:
        MemobenchError: when no usable library is there, as on any system but Linux.
    """
    if problem := unsupported_system():
        raise MemobenchError(problem)
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted == "glfw":
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            raise MemobenchError(
                "MUJOCO_GL is 'glfw', which needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set; "
                "set MUJOCO_GL to egl or osmesa"
            )
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


def _gl_context() -> Any:
    """Open a small context: frames are drawn into framebuffers of their own size."""
    backend = gl_backend()
    os.environ["MUJOCO_GL"] = backend
    try:
        if backend == "egl":
            context = _egl_context()
        elif backend == "osmesa":
            from mujoco.osmesa import GLContext

            context = GLContext(*CONTEXT_SIZE)
        else:
            from mujoco import glfw

            context = glfw.GLContext(*CONTEXT_SIZE)
        context.make_current()
        return context
    except Exception as error:  # each backend fails in its own way: missing driver, no device, no display
        other = "osmesa" if backend == "egl" else "egl"
        raise MemobenchError(
            f"the GL backend {backend!r} could not open a context ({error}); try MUJOCO_GL={other}, and see "
            "`memobench doctor`"
        ) from error


def _egl_context() -> Any:
    """Return an EGL context on the GPU of this process's rank, or on the first device that MuJoCo can open."""
    from mujoco import egl

    number = None if DEVICE_ID in os.environ or egl.EGL_DISPLAY is not None else egl_device(_cuda_devices(egl))
    if number is not None:
        os.environ[DEVICE_ID] = str(number)
        try:
            return egl.GLContext(*CONTEXT_SIZE)
        except Exception:  # it may be another job's
            egl.EGL_DISPLAY = None
        finally:
            del os.environ[DEVICE_ID]
    return egl.GLContext(*CONTEXT_SIZE)


def egl_device(devices: Mapping[int, int]) -> int | None:
    """Return the number among EGL's devices of the GPU that this process draws on; None: as MuJoCo chooses.

    EGL knows nothing of CUDA_VISIBLE_DEVICES: by itself every process of a node would draw on the node's first GPU.
    Where a process sees several, those of a node take turns by their rank on it.

    Args:
        devices: CUDA's number of each GPU -> EGL's.
    """
    told = os.environ.get("CUDA_VISIBLE_DEVICES")
    rank = next((os.environ[name] for name in RANKS if os.environ.get(name, "").isdecimal()), None)
    if not devices or (told is None and rank is None):
        return None
    seen = (
        [part.strip() for part in told.split(",")] if told is not None else [str(device) for device in sorted(devices)]
    )
    picked = seen[int(rank or 0) % len(seen)]
    return devices.get(int(picked)) if picked.isdecimal() else None  # a name such as GPU-1f0c… says nothing to EGL


def _cuda_devices(egl: Any) -> dict[int, int]:
    """Return CUDA's number of each GPU -> its number among EGL's devices; {} where the driver tells none."""
    try:
        address = egl.EGL.eglGetProcAddress("eglQueryDeviceAttribEXT")
        query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_void_p, ctypes.c_int, ctypes.POINTER(ctypes.c_ssize_t))(
            address
        )
        found, told = {}, ctypes.c_ssize_t()
        for number, device in enumerate(egl.EGL.eglQueryDevicesEXT()):
            if query(device, CUDA_DEVICE, told):
                found[int(told.value)] = number
    except Exception:  # each driver lacks it in its own way; MuJoCo then finds a device by itself
        return {}
    return found


CACHED_RENDERERS = 4
"""Renderers kept per thread: each holds its scene's textures, some 20 MB."""


class _Thread(threading.local):
    """The GL context of a thread, and the renderers that live in it; a context serves one thread at a time."""

    def __init__(self) -> None:
        self.context: Any = None
        self.renderers: OrderedDict[tuple[Any, RenderSettings], Rasterizer] = OrderedDict()

    def current(self) -> None:
        """Make this thread's context current, which is opened at the first call.

        Raises:
            MemobenchError: no context can be opened, or the process was forked from one that had drawn.
        """
        global _drawing_process
        if _drawing_process not in (None, os.getpid()):
            # A fork copies neither the driver's threads nor its locks: the first frame would never come.
            raise MemobenchError(
                "this process was forked from one that had already rendered, which GL drivers do not survive; start "
                "workers with the spawn or forkserver method, or render in the workers only"
            )
        _drawing_process = os.getpid()
        if self.context is None:
            self.context = _gl_context()
            # Registered after MuJoCo's backend has registered its own closing, and so called before it.
            atexit.unregister(close_renderers)
            atexit.register(close_renderers)
        else:
            self.context.make_current()

    def close(self) -> None:
        """Free renderers and context."""
        if self.context is None or _drawing_process != os.getpid():
            return
        self.context.make_current()
        while self.renderers:
            self.renderers.popitem()[1].free()
        self.context.free()
        self.context = None


_drawing_process: int | None = None
"""Id of the process that opened a context, here or before a fork."""
_thread = _Thread()


def get_renderer(key: Any, model: mujoco.MjModel, settings: RenderSettings) -> Rasterizer:
    """Return this thread's renderer for a scene, made at its first frame; the thread's context is current.

    Simulations of the same scene share it: meshes and textures are the scene's, poses come with each frame's data.
    """
    _thread.current()
    renderers = _thread.renderers
    full = (key, settings)
    if full not in renderers:
        while len(renderers) >= CACHED_RENDERERS:
            renderers.popitem(last=False)[1].free()
        renderers[full] = make_renderer(model, settings)
    renderers.move_to_end(full)
    return renderers[full]


def make_renderer(model: mujoco.MjModel, settings: RenderSettings) -> Rasterizer:
    """Return a renderer of one's own for a scene, to be freed by `Rasterizer.free`; see `get_renderer`."""
    _thread.current()
    quality = QUALITIES[settings.quality]
    draw_list = build_draw_list(model, BACKGROUND, ROOM, whole_arm() if quality.whole_arm else None)
    return Rasterizer(model, draw_list, settings.width, settings.height, quality.samples, quality.shadow_map)


def renderer_name() -> str:
    """Return what the driver calls the device that draws in this thread (``llvmpipe …``); opens the GL context."""
    _thread.current()
    from OpenGL import GL

    return str(GL.glGetString(GL.GL_RENDERER).decode())


def close_renderers() -> None:
    """Free the calling thread's renderers and GL context; the next frame opens them anew.

    A thread that has drawn calls this before it ends; for the main thread it happens at exit.
    """
    _thread.close()
