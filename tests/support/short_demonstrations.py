"""Demonstrations of the simulator: of the expert, or short ones of random actions, with images of any size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lerobot_memobench.constants import CAMERAS
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.generate import RecordingSettings, compiled_episode, record
from lerobot_memobench.datasets.validate import resimulate
from lerobot_memobench.sim.simulation import RenderSettings, Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import Task


def record_demonstration(task: Task, seed: int, *, variant: int = 0, **settings: Any) -> Demonstration:
    """Record a demonstration of the expert, with its images; ``settings`` are fields of `RecordingSettings`."""
    chosen = RecordingSettings(**settings)
    shown: list[dict[str, np.ndarray]] = []
    demo = record(compiled_episode(task.variant(variant), chosen), seed, chosen, shown.append)
    if not shown:
        return demo
    return replace(demo, images={name: np.stack([images[name] for images in shown]) for name in shown[0]})


def drawn_steps(
    task_name: str, seed: int, frames: int, exec_start: int = 0, holds: Sequence[tuple[int, int]] = ()
) -> Demonstration:
    """Return as many steps of drawn actions; ``exec_start`` of them are of the prompt.

    Args:
        holds: first held frame and the frame after the last one of each hold.
    """
    actions = np.random.default_rng(seed).uniform(-1, 1, (frames, 7)).astype(np.float32)
    held = np.zeros(frames, np.bool_)
    for start, end in holds:
        held[start:end] = True
    actions[held] = 0
    return resimulate(get_task(task_name), seed, actions, exec_start, held=held)


def beginning(demo: Demonstration, frames: int) -> Demonstration:
    """Return the first steps of a demonstration as one of its own."""
    held = None if demo.held is None else demo.held[:frames]
    found = resimulate(demo.task, demo.seed, demo.applied[:frames], demo.exec_start, held=held)
    executed = None if demo.executed is None else demo.executed[:frames]
    return replace(
        found, actions=demo.actions[:frames], executed=executed, referent=demo.referent, variant=demo.variant
    )


def with_images(demo: Demonstration, size: int) -> Demonstration:
    sim = Simulation(demo.task, RenderSettings(size, size))
    sim.reset(demo.seed)
    images: dict[str, list[np.ndarray]] = {name: [] for name in CAMERAS}
    for state in demo.states:
        sim.set_state(state, demo.fixture_poses)
        for name, camera in CAMERAS.items():
            images[name].append(sim.render(camera))
    return replace(demo, images={name: np.stack(frames) for name, frames in images.items()})
