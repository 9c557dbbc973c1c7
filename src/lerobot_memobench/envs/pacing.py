"""Pauses and slower actions during the execution. Both separate memory from a clock.

The environment asks the policy at every control step, also in a pause. Actions and observations stay the same; only
their times change.

A pause starts and ends between two chunks of ``replan_steps`` actions, because losing part of a chunk would disturb the
motion, not the sense of time. A lower speed stretches a chunk as a whole; actions received meanwhile have no effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.envs.settings import EnvSettings, steps_per_action

STEPS_BETWEEN_PAUSES = (20, 120)
"""Smallest and largest number of execution steps between two pauses, drawn uniformly."""


class Pacing:
    """Map the policy's actions to the actions that are executed.

    Args:
        settings: uses ``pause_steps``; ``speed``: at 1/n an action takes n control steps, each with 1/n of its
            displacement; ``replan_steps``: actions per prediction.
        rng: draws the start of each pause.

    Attributes:
        pauses: whether the settings contain pauses.
        paused_steps: control steps of pauses so far.
    """

    def __init__(self, settings: EnvSettings, rng: np.random.Generator) -> None:
        self._chunk, self._stretch = settings.replan_steps or 1, steps_per_action(settings.speed)
        self._pause = _whole_chunks(settings.pause_steps, self._chunk)
        self.pauses = self._pause > 0
        self._rng = rng
        self._actions: list[NDArray[np.float32]] = []  # of the current chunk
        self._step = 0  # within the current chunk
        self._until_pause = self._gap()  # execution steps
        self._rests = 0  # remaining steps of this pause
        self.paused_steps = 0

    def _gap(self) -> int:
        return int(self._rng.integers(*STEPS_BETWEEN_PAUSES, endpoint=True)) if self.pauses else 0

    @property
    def action_has_effect(self) -> bool:
        """Whether the next action is executed."""
        return not self._rests and self._step < self._chunk

    def step(self, action: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the executed action (7,) for the policy's action (7,) in [−1, 1]; None in a pause."""
        if self._rests:
            self._rests -= 1
            self.paused_steps += 1
            return None
        if self._step < self._chunk:
            self._actions.append(action)
        slowed = self._actions[self._step // self._stretch].copy()
        slowed[:-1] /= self._stretch  # the gripper is no displacement
        self._step += 1
        self._until_pause -= 1
        if self._step == self._chunk * self._stretch:
            self._actions, self._step = [], 0
            if self.pauses and self._until_pause <= 0:
                self._rests, self._until_pause = self._pause, self._gap()
        return slowed


def longest(settings: EnvSettings) -> int:
    """Return the maximum number of control steps of an execution, including pauses."""
    steps = settings.horizon * steps_per_action(settings.speed)
    return steps + steps // STEPS_BETWEEN_PAUSES[0] * _whole_chunks(settings.pause_steps, settings.replan_steps or 1)


def _whole_chunks(steps: int, chunk: int) -> int:
    return -(-steps // chunk) * chunk
