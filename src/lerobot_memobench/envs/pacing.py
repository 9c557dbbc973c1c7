"""How an execution is paced: pauses in which the robot rests, and slower actions. Both tell a memory from a clock.

The environment makes them alone, so they hold for any policy: it is asked at every control step as always, and its
clock goes on. What was done and seen stays the same; only when it happened does not.

A policy that plans a chunk of ``replan_steps`` actions must not lose a part of one, or its hand would be disturbed and
not its sense of time. So a pause begins and ends where a chunk does. Slower, a chunk is stretched as a whole, and those
that are planned until it has been carried out have no effect.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import ACTION_DIM

GAP = (20, 120)
"""Execution steps between two pauses, drawn uniformly from these, both included."""
SLOWEST = 10
"""Control steps that an action may take."""


class Pacing:
    """What of a policy's actions takes effect in an execution, and when.

    Args:
        pause_steps: control steps of a pause; 0: there are none.
        speed: 1, or 1/n where an action takes n control steps, in each of which its displacement is an nth.
        replan_steps: actions that the policy executes per prediction; 1 when None.
        rng: source of the moments at which pauses begin.

    Attributes:
        pauses: whether there are any.
        paused_steps: control steps of pauses so far.
    """

    def __init__(self, pause_steps: int, speed: float, replan_steps: int | None, rng: np.random.Generator) -> None:
        self._chunk, self._stretch = replan_steps or 1, steps_per_action(speed)
        self._pause = _whole_chunks(pause_steps, self._chunk)
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


def steps_per_action(speed: float) -> int:
    """Return how many control steps an action takes at a speed."""
    return round(1 / speed)


def check_pacing(prefix: str, pause_steps: int, speed: float) -> None:
    """Refuse what is no length of a pause or no speed; ``prefix`` stands before a setting's name.

    Raises:
        MemobenchError: it is none.
    """
    if isinstance(pause_steps, bool) or not isinstance(pause_steps, int | np.integer) or pause_steps < 0:
        raise MemobenchError(f"{prefix}pause_steps is {pause_steps!r}; expected a whole number of control steps, or 0")
    numeric = isinstance(speed, int | float) and not isinstance(speed, bool)
    if not numeric or not 1 / SLOWEST <= speed <= 1 or abs(steps_per_action(speed) * speed - 1) > 0.02:
        raise MemobenchError(
            f"{prefix}speed is {speed!r}; expected 1, 0.5, 0.33, 0.25 and so on down to {1 / SLOWEST}: an action takes "
            "a whole number of control steps"
        )


def longest(horizon: int, pause_steps: int, speed: float, replan_steps: int | None) -> int:
    """Return the most control steps that an execution of so many steps at full speed takes, pauses included."""
    steps = horizon * steps_per_action(speed)
    return steps + steps // GAP[0] * _whole_chunks(pause_steps, replan_steps or 1)


def _whole_chunks(steps: int, chunk: int) -> int:
    return -(-steps // chunk) * chunk


NOTHING: NDArray[np.float32] = np.zeros(ACTION_DIM, np.float32)
"""What moves the arm in a pause."""
