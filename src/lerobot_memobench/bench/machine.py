"""What a measurement was made on."""

from __future__ import annotations

import platform
from functools import cache
from pathlib import Path

import mujoco

from lerobot_memobench.jobs.threads import cores
from lerobot_memobench.sim.rendering import close_renderers, gl_backend
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
"""What is measured unless another task is named: its bowls have the most contacts of the catalogue's usual scenes."""


@cache
def machine() -> str:
    """Return processor, cores, GL device and versions, for a reader to compare with."""
    return f"{_processor()}, {cores()} cores, {_gl_device()}, {platform.system()}, mujoco {mujoco.__version__}"


def _processor() -> str:
    model = platform.processor() or platform.machine()
    try:
        names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    except OSError:
        return model
    return names[0].split(":", 1)[1].strip() if names else model


def _gl_device() -> str:
    sim = Simulation(get_task(TASK))
    sim.reset(0)
    sim.render()  # opens a context and chooses PyOpenGL's platform, which its import fixes
    from OpenGL import GL

    device = GL.glGetString(GL.GL_RENDERER).decode()
    close_renderers()
    return f"{gl_backend()} on {device}"
