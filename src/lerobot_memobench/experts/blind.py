"""A routine without a memory: the published task's, again and again, whatever was shown or is asked."""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.experts.expert import Expert
from lerobot_memobench.experts.travel import come_home
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.task import Task


class BlindRoutine:
    """Carries out a published task's goal, comes home and begins anew; nothing is carried over from one round to the
    next, so it cannot count, and it knows neither what was hidden nor what was pointed at.

    Args:
        task: the published task; of a strict one the task it is derived from.
        sim: the running scene, at the start of the execution.
        rng: source of small variation.
    """

    def __init__(self, task: Task, sim: Simulation, rng: np.random.Generator) -> None:
        self._task, self._sim, self._rng = task, sim, rng
        self._home = sim.eef_pose()
        self._doing = self._rounds()

    def act(self) -> NDArray[np.float32]:
        """Return the action (7,) for the present state; ask once per control step."""
        return np.clip(next(self._doing), -1.0, 1.0)

    def _rounds(self) -> Generator[NDArray[np.float32], None, None]:
        while True:
            expert = Expert(self._task, self._sim, self._rng)
            while not expert.done:
                yield expert.act()
            yield from come_home(expert.hand, *self._home)
