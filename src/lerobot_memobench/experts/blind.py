"""A routine without a memory: the published task's, again and again, whatever was shown or is asked."""

from __future__ import annotations

import numpy as np

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.hand import Steps
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import Task


def blind_routine(task: Task, sim: Simulation, rng: np.random.Generator) -> Steps:
    """Carry out a published task's goal, come home and begin anew, for ever.

    Nothing is carried over from one round to the next, so it cannot count, and it knows neither what was hidden nor
    what was pointed at.

    Args:
        task: the published task; of a strict one the task it is derived from.
        sim: the running scene; where its hand is at the first action is home.
        rng: source of small variation.
    """
    home = sim.eef_pose()
    while True:
        expert = Expert(task, sim, rng)
        while not expert.done:
            yield expert.act()
        yield from come_home(expert.hand, *home)
