"""Seeing the world and not where the arm happens to be: the arm is put back to where the execution began."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING

from lerobot_memobench.evaluation.necessity.pictures import Picture, photograph

if TYPE_CHECKING:
    from lerobot_memobench.sim.simulation import Simulation

SETTLE = 12
"""Steps for which the world comes to rest before a picture with the arm at home; more than a `Then` asks for."""


class Home:
    """Puts the arm back to where the execution began; the world stays as it is.

    Args:
        sim: a simulation that was just reset.
    """

    def __init__(self, sim: Simulation) -> None:
        from lerobot_memobench.sim.robot import ARM_JOINTS, FINGER_JOINTS

        self._sim, self._start = sim, sim.snapshot()
        joints = [sim.model.joint(name) for name in (*ARM_JOINTS, *FINGER_JOINTS)]
        # A snapshot begins with time, positions and velocities.
        self._places = [1 + int(joint.qposadr[0]) for joint in joints]
        self._places += [1 + sim.model.nq + int(joint.dofadr[0]) for joint in joints]

    def go(self) -> None:
        """Put joints, velocities and the controller's goal of the arm back."""
        now = self._sim.snapshot()
        physics = now.physics.copy()
        physics[self._places] = self._start.physics[self._places]
        self._sim.restore(dataclasses.replace(self._start, physics=physics))

    def settle(self) -> Iterator[None]:
        """Come home and hold still for `SETTLE` steps, yielding after each; end exactly at home."""
        from lerobot_memobench.sim.simulation import NO_OP

        self.go()
        for _ in range(SETTLE):
            self._sim.step(NO_OP)
            yield
        self.go()

    def look(self) -> tuple[Picture, ...]:
        """Return what the cameras would see with the arm at home; the simulation goes on as if nothing had been."""
        before = self._sim.snapshot()
        for _ in self.settle():
            pass
        pictures = photograph(self._sim)
        self._sim.restore(before)
        return pictures
