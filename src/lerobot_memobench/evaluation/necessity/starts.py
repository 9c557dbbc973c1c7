"""How an execution begins: as the scene was drawn, or as a hiding left it."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from lerobot_memobench.tasks.task import Prompt, Task

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation, Snapshot

HIDINGS = 12
"""Hidings kept per process: a demonstration and a search begin at the same ones."""


def begin(task: Task, sim: Simulation, seed: int) -> None:
    """Bring a simulation to where the execution of a task (or a variant of it) begins."""
    sim.reset(seed)
    if task.prompt is not None and not task.prompt.restores:
        sim.restore(_after_hiding(task.variant(0), task.prompt, seed))
        sim.begin_execution()


@lru_cache(maxsize=HIDINGS)
def _after_hiding(task: Task, prompt: Prompt, seed: int) -> Snapshot:
    """Play a prompt as an episode of this seed does, and return what it leaves."""
    from lerobot_memobench.envs.episode import Episode
    from lerobot_memobench.protocol import ACTION_DIM, PROMPT

    episode = Episode(dataclasses.replace(task, prompt=prompt, drawn=False))
    episode.reset(seed)
    while episode.phase == PROMPT:
        episode.step(np.zeros(ACTION_DIM))
    return episode.sim.snapshot()
