"""What this machine draws pictures with, decodes videos with and runs policies on."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

from lerobot_memobench.doctor.findings import Finding
from lerobot_memobench.doctor.golden import TOLERANCE
from lerobot_memobench.doctor.probe import run_probe
from lerobot_memobench.errors import MemobenchError, unsupported_system
from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.sim.rendering import BACKENDS, gl_backend

SYSTEM_PACKAGES = "apt-get install libegl1 libgl1-mesa-dri libgles2 libopengl0 libosmesa6"

#: GL renderers that run on the CPU.
SOFTWARE = ("llvmpipe", "softpipe", "swrast", "swiftshader")


def rendering() -> Iterator[Finding]:
    """Yield what each GL backend really does here; nothing where there can be none."""
    if unsupported_system():
        return
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    try:
        chosen = gl_backend()
    except MemobenchError as error:
        chosen = ""
        fix = SYSTEM_PACKAGES if wanted in ("", *BACKENDS) else "unset MUJOCO_GL, or set it to egl or osmesa"
        yield Finding("GL backend", "failed", str(error), fix)
    else:
        origin = "MUJOCO_GL" if wanted else "the first whose library is installed"
        yield Finding("GL backend", "ok", f"{chosen} ({origin})")
    for backend in BACKENDS:
        yield _backend(backend, used=backend == chosen)


def _backend(backend: str, used: bool) -> Finding:
    """Let a backend draw a sphere; only the one in use must be able to."""
    answer = run_probe("gl", backend)
    what = f"GL {backend}" + (" (used)" if used else "")
    if "error" not in answer and answer["sphere"]:
        return _renderer(what, answer["renderer"], answer["version"])
    problem = answer["error"] if "error" in answer else f"{answer['renderer']} draws a wrong picture"
    return Finding(what, "failed" if used else "warning", problem, _gl_fix(backend, used))


def _gl_fix(backend: str, used: bool) -> str:
    other = next(name for name in BACKENDS if name != backend)
    return SYSTEM_PACKAGES + (f", or set MUJOCO_GL={other}" if used else f" (only if {backend} is wanted)")


def _renderer(what: str, renderer: str, version: str) -> Finding:
    software = any(name in renderer.lower() for name in SOFTWARE)
    detail = f"{renderer}, {version}" + (" (software, on the CPU)" if software else "")
    if software and "egl" in what and Path("/dev/nvidia0").exists():
        return Finding(
            what,
            "warning",
            detail + ", though there is an NVIDIA GPU",
            "install the driver's GL libraries (in containers: NVIDIA_DRIVER_CAPABILITIES=all)",
        )
    return Finding(what, "ok", detail)


def golden_frame() -> Finding:
    """Compare a frame of the benchmark with the one that ships."""
    answer = run_probe("golden")
    if "error" in answer:
        fix = "unset PYOPENGL_PLATFORM" if "PYOPENGL_PLATFORM" in answer["error"] else "mend what failed above first"
        return Finding("golden frame", "failed", answer["error"], fix)
    off = answer["difference"]
    detail = f"mean difference {off:.2f} of 255 (tolerance {TOLERANCE:g})"
    if off > TOLERANCE:
        fix = "the pictures here are not the benchmark's; try the other MUJOCO_GL backend or a newer driver"
        return Finding("golden frame", "failed", detail, fix)
    return Finding("golden frame", "ok", detail)


def ffmpeg() -> Finding:
    """Look for the program ffmpeg."""
    program = shutil.which("ffmpeg")
    if program is None:
        return Finding("FFmpeg", "warning", "no ffmpeg on the PATH", "apt-get install ffmpeg")
    lines = subprocess.run([program, "-version"], capture_output=True, text=True, check=False).stdout.splitlines()
    return Finding("FFmpeg", "ok", lines[0] if lines else program)


def torchcodec() -> Finding:
    """Try the decoder that LeRobot prefers."""
    answer = run_probe("torchcodec")
    if "error" in answer:
        return Finding(
            "video decoding",
            "warning",
            f"torchcodec does not load ({answer['error']}); LeRobot falls back to PyAV, which is slower",
            "apt-get install ffmpeg (its libraries are what torchcodec needs)",
        )
    return Finding("video decoding", "ok", "torchcodec loads FFmpeg's libraries")


def device() -> Finding:
    """Say what policies run on here."""
    import torch

    if torch.cuda.is_available():
        return Finding("device", "ok", f"{torch.cuda.get_device_name()} ({torch.cuda.device_count()} in all)")
    return Finding("device", "ok", f"CPU, {cores()} cores; enough for size=tiny and the expert")
