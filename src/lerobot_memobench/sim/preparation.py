"""Prepare a machine for its first episodes: compile functions, and cache the meshes and textures of scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from lerobot_memobench.jobs.processes import process_pool
from lerobot_memobench.sim.simulation import MJCF_CAMERAS, Simulation
from lerobot_memobench.tasks.catalogue import get_task


def prepare(names: Sequence[str], workers: int) -> Iterator[str]:
    """Simulate and draw the first scene of each task, and yield its name."""
    yield _draw(names[0])  # compiles the functions and caches the arm, which the other processes only load
    with process_pool(workers) as pool:
        yield from pool.map(_draw, names[1:])


def _draw(name: str) -> str:
    simulation = Simulation(get_task(name))
    simulation.reset(0)
    for camera in MJCF_CAMERAS:
        simulation.render(camera)
    return name
