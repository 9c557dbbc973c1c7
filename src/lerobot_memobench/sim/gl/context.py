"""GL backends, and one context per thread that all its renderers share."""

from __future__ import annotations

import atexit
import ctypes.util
import importlib
import os
import sys
import threading
from typing import Any

from lerobot_memobench.errors import MemobenchError

BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}
"""MuJoCo's headless backends and the system library each needs."""

CONTEXT_SIZE = (64, 64)


def gl_backend() -> str:
    """Return the backend to draw with: ``MUJOCO_GL`` where set, else the first whose library is installed.

    Raises:
        MemobenchError: when no usable library is there, as on any system but Linux.
    """
    if sys.platform != "linux":
        raise MemobenchError(
            f"env.render=high needs EGL or OSMesa on Linux, found {sys.platform}; use env.render=default"
        )
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
        f"no GL library for env.render=high ({missing} not found): use env.render=default, run `make setup` as root, "
        "or install the Debian packages libegl1, libgl1-mesa-dri and libosmesa6"
    )


def _gl_context() -> Any:
    """Open a small context: frames are drawn into framebuffers of their own size."""
    backend = gl_backend()
    os.environ["MUJOCO_GL"] = backend
    try:
        context = importlib.import_module(f"mujoco.{backend}").GLContext(*CONTEXT_SIZE)
        context.make_current()
        return context
    except Exception as error:  # each backend fails in its own way: missing driver, no device, no display
        other = "osmesa" if backend == "egl" else "egl"
        raise MemobenchError(
            f"the GL backend {backend!r} could not open a context ({error}); try env.render=default, which needs none, "
            f"or MUJOCO_GL={other}, and see `memobench doctor`"
        ) from error


class _Thread(threading.local):
    """The GL context of a thread; a context serves one thread at a time."""

    context: Any = None


_thread = _Thread()
_drawing_process: int | None = None
"""Id of the process that opened a context, here or before a fork."""


def enter_context() -> None:
    """Make this thread's context current, which is opened at the first call.

    Raises:
        MemobenchError: no context can be opened, or the process was forked from one that had drawn.
    """
    global _drawing_process
    if _drawing_process not in (None, os.getpid()):
        # A fork copies neither the driver's threads nor its locks: the first frame would never come.
        raise MemobenchError(
            "this process was forked from one that had already rendered with GL, which drivers do not survive; start "
            "workers with the spawn or forkserver method, or use env.render=default"
        )
    _drawing_process = os.getpid()
    if _thread.context is None:
        _thread.context = _gl_context()
        # Registered after MuJoCo's backend has registered its own closing, and so called before it.
        atexit.unregister(close_context)
        atexit.register(close_context)
    else:
        _thread.context.make_current()


def renderer_name() -> str:
    """Return what the driver calls the device that draws in this thread (``llvmpipe …``); opens the GL context."""
    enter_context()
    from OpenGL import GL

    return str(GL.glGetString(GL.GL_RENDERER).decode())


def context_is_open() -> bool:
    """Return whether this thread has a context that this process opened."""
    return _thread.context is not None and _drawing_process == os.getpid()


def close_context() -> None:
    """Free this thread's context, and with it all that was made in it; the next frame opens another."""
    if context_is_open():
        _thread.context.make_current()
        _thread.context.free()
        _thread.context = None
