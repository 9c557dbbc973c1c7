"""Demonstrations of the real simulator that cost next to nothing: few steps, and pictures of any size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.replay import resimulate
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.sim.rendering import RenderSettings
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import MEMOBENCH


def drawn_steps(task_name: str, seed: int, frames: int, exec_start: int = 0, world: str = MEMOBENCH) -> Demonstration:
    """Return as many steps of drawn actions; ``exec_start`` of them are of the prompt."""
    actions = np.random.default_rng(seed).uniform(-1, 1, (frames, 7)).astype(np.float32)
    return resimulate(get_task(task_name).in_world(world), seed, actions, exec_start)


def beginning(demo: Demonstration, frames: int) -> Demonstration:
    """Return the first steps of a demonstration as one of its own."""
    found = resimulate(demo.task, demo.seed, demo.applied[:frames], demo.exec_start)
    executed = None if demo.executed is None else demo.executed[:frames]
    return replace(
        found, actions=demo.actions[:frames], executed=executed, referent=demo.referent, variant=demo.variant
    )


def with_pictures(demo: Demonstration, size: int) -> Demonstration:
    """Return it with the cameras' images."""
    sim = Simulation(demo.task, RenderSettings(size, size))
    sim.reset(demo.seed)
    images: dict[str, list[np.ndarray]] = {name: [] for name in CAMERAS}
    for state in demo.states:
        sim.set_state(state, demo.fixture_poses)
        for name, camera in CAMERAS.items():
            images[name].append(sim.render(camera))
    return replace(demo, images={name: np.stack(frames) for name, frames in images.items()})
