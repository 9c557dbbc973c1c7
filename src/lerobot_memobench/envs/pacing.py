"""Pacing of an execution: pauses in which the robot rests, and slower actions. Both distinguish a memory from a clock.

The environment applies them to any policy: it asks the policy at every control step, and the clock runs. Actions and
observations stay the same; their times change.

A policy that plans chunks of ``replan_steps`` actions must not lose part of a chunk: that would disturb its motion and
not its sense of time. So a pause begins and ends between two chunks. At a lower speed a chunk is stretched as a whole;
actions planned before it has been carried out have no effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.settings import EnvSettings, steps_per_action
from lerobot_memobench.protocol import ACTION_DIM

GAP = (20, 120)
"""Execution steps between two pauses, drawn uniformly from these, both included."""


class Pacing:
    """What of a policy's actions takes effect in an execution, and when.

    Args:
        settings: ``pause_steps``; ``speed``, 1/n where an action takes n control steps, in each of which its
            displacement is an nth; ``replan_steps``, actions that the policy executes per prediction.
        rng: source of the moments at which pauses begin.

    Attributes:
        pauses: whether there are any.
        paused_steps: control steps of pauses so far.
    """

    def __init__(self, settings: EnvSettings, rng: np.random.Generator) -> None:
        self._chunk, self._stretch = settings.replan_steps or 1, steps_per_action(settings.speed)
        self._pause = _whole_chunks(settings.pause_steps, self._chunk)
        self.pauses = self._pause > 0
        self._rng = rng
        self._actions: list[NDArray[np.float32]] = []  # of the chunk that is carried out
        self._step = 0  # of that chunk
        self._left = self._gap()  # execution steps until the next pause
        self._rests = 0  # steps that are left of this pause
        self.paused_steps = 0

    def _gap(self) -> int:
        return int(self._rng.integers(*GAP, endpoint=True)) if self.pauses else 0

    @property
    def heeds(self) -> bool:
        """Whether the next action takes effect."""
        return not self._rests and self._step < self._chunk

    def step(self, action: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Take the policy's action (7,) in [−1, 1]; return the one of this control step, None where the robot rests."""
        if self._rests:
            self._rests -= 1
            self.paused_steps += 1
            return None
        if self._step < self._chunk:
            self._actions.append(action)
        slowed = self._actions[self._step // self._stretch].copy()
        slowed[:-1] /= self._stretch  # the gripper's part is no displacement
        self._step += 1
        self._left -= 1
        if self._step == self._chunk * self._stretch:
            self._actions, self._step = [], 0
            if self.pauses and self._left <= 0:
                self._rests, self._left = self._pause, self._gap()
        return slowed


def longest(settings: EnvSettings) -> int:
    """Return the most control steps that an execution takes, pauses included."""
    steps = settings.horizon * steps_per_action(settings.speed)
    return steps + steps // GAP[0] * _whole_chunks(settings.pause_steps, settings.replan_steps or 1)


def _whole_chunks(steps: int, chunk: int) -> int:
    return -(-steps // chunk) * chunk


NOTHING: NDArray[np.float32] = np.zeros(ACTION_DIM, np.float32)
"""What moves the arm in a pause."""
