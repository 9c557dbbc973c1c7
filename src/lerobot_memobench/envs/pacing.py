"""Pauses, holds and slower actions during the execution. They separate memory from a clock.

The environment asks the policy at every control step, also in a pause or a hold. Actions and observations stay the
same; only their times change.

A pause starts and ends between two chunks of ``replan_steps`` actions, because losing part of a chunk would disturb the
motion, not the sense of time. A lower speed stretches a chunk as a whole; actions received meanwhile have no effect.

A hold begins when a strict task's hand comes home after an event, and ends between two chunks. It is longer than a
plan: the first plan that has an effect after it has observed home alone. So neither a chunk of actions nor a window of
observations carries the event past home.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.constants import LONGEST_HOLD, MOST_HOLDS
from lerobot_memobench.envs.settings import EnvSettings, steps_per_action
from lerobot_memobench.tasks.task import STRICT

STEPS_BETWEEN_PAUSES = (20, 120)  # smallest and largest number of execution steps between two pauses, drawn uniformly
FEWEST_STEPS_AWAY = 2  # smallest number of execution steps between two holds: the hand leaves home and returns


class Pacing:
    """Map the policy's actions to the actions that are executed; ``rng`` draws the starts of pauses.

    At a ``speed`` of 1/n an action takes n control steps, each with 1/n of its displacement.
    """

    def __init__(self, settings: EnvSettings, rng: np.random.Generator) -> None:
        self._chunk, self._stretch = settings.replan_steps or 1, steps_per_action(settings.speed)
        self._pause = _whole_chunks(settings.pause_steps, self._chunk)
        self.pauses = self._pause > 0
        self._rng = rng
        self._actions: list[NDArray[np.float32]] = []  # of the current chunk
        self._step = 0  # within the current chunk
        self._until_pause = self._pause_interval()  # execution steps
        self._rests = self._held = 0  # remaining steps of this pause, of this hold
        self.paused_steps = self.held_steps = 0  # so far
        self._shortest_hold = shortest_hold(settings)

    def _pause_interval(self) -> int:
        return int(self._rng.integers(*STEPS_BETWEEN_PAUSES, endpoint=True)) if self.pauses else 0

    @property
    def action_has_effect(self) -> bool:
        """Whether the next action is executed."""
        return not self._rests and not self._held and self._step < self._chunk

    def hold(self, steps: int) -> None:
        """Hold the scene for at least ``steps`` control steps, longer than a plan, until a chunk begins."""
        steps = max(steps, self._shortest_hold)
        # Round up, so that the hold ends where a chunk of the policy ends; the interrupted chunk is dropped.
        self._held = steps + -(self._step + steps) % (self._chunk * self._stretch)
        self._actions, self._step = [], 0

    def step(self, action: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the executed action (7,) for the policy's action (7,) in [−1, 1]; None in a pause or a hold."""
        if self._rests:
            self._rests -= 1
            self.paused_steps += 1
            return None
        if self._held:
            self._held -= 1
            self.held_steps += 1
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
                self._rests, self._until_pause = self._pause, self._pause_interval()
        return slowed


def shortest_hold(settings: EnvSettings) -> int:
    """Return the minimum number of control steps of a hold.

    A plan of K actions begins d steps after its observation and is made from a window of W steps. If the first step of
    the window is the last before home, the plan acts until step W + d + K − 3 after the arrival.
    """
    length = (settings.replan_steps or 1) * steps_per_action(settings.speed)
    return settings.window_steps + settings.delay_steps + length - 1


def longest(settings: EnvSettings) -> int:
    """Return the maximum number of control steps of an execution, including pauses and holds."""
    steps, chunk = settings.horizon * steps_per_action(settings.speed), settings.replan_steps or 1
    pauses = steps // STEPS_BETWEEN_PAUSES[0] * _whole_chunks(settings.pause_steps, chunk)
    if settings.suite != STRICT:
        return steps + pauses
    shortest, round_up = shortest_hold(settings), chunk * steps_per_action(settings.speed)
    drawn = MOST_HOLDS * (max(LONGEST_HOLD, shortest) + round_up)
    return steps + pauses + drawn + steps // FEWEST_STEPS_AWAY * (shortest + round_up)


def _whole_chunks(steps: int, chunk: int) -> int:
    return -(-steps // chunk) * chunk
