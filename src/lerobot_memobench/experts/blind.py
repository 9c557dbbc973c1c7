"""A baseline without memory: repeat the published task's routine, regardless of prompt and instruction."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.hand import Steps
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import Task


def blind_routine(task: Task, sim: Simulation, rng: np.random.Generator) -> Steps:
    """Reach a published task's goal, return home and repeat, forever.

    No state is kept between rounds, so the routine cannot count, and it ignores hidden and indicated objects.

    Args:
        task: published task; for a strict task the one it is derived from.
        sim: running simulation; the hand's pose at the first action is home.
        rng: random source of small variations.
    """
    home = sim.eef_pose()
    while True:
        expert = Expert(task, sim, rng)
        while not expert.done:
            yield expert.act()
        yield from come_home(expert.hand, *home)
