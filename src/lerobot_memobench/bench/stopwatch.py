"""What a control step costs, whatever takes it: noted where vector environments step and LeRobot's evaluation ends."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple
from unittest.mock import patch

import gymnasium as gym


class Cost(NamedTuple):
    """Of one control step, s: by the clock on the wall, and of all processors together."""

    wall: float
    cpu: float


class Stopwatch:
    """Counts the steps of vector environments, and tells what each has cost since the first."""

    def __init__(self) -> None:
        self.steps, self._start, self._end = 0, Cost(0, 0), Cost(0, 0)

    def step(self) -> None:
        """Note that a step begins."""
        if not self.steps:
            self._start = Cost(time.perf_counter(), time.process_time())
        self.steps += 1

    def end(self) -> None:
        """Note that all is done."""
        self._end = Cost(time.perf_counter(), time.process_time())

    @property
    def cost(self) -> Cost:
        """Of one step."""
        spent = (end - start for start, end in zip(self._start, self._end, strict=True))
        return Cost(*(seconds / self.steps for seconds in spent))


@contextmanager
def stopwatch() -> Iterator[Stopwatch]:
    """Yield a watch that notes the steps of vector environments in this process and the end of LeRobot's evaluation."""
    from lerobot.scripts import lerobot_eval

    watch, step, evaluate = Stopwatch(), gym.vector.SyncVectorEnv.step, lerobot_eval.eval_policy

    def noted_step(self: gym.vector.SyncVectorEnv, actions: Any) -> Any:
        watch.step()
        return step(self, actions)

    def noted_evaluation(*args: Any, **settings: Any) -> Any:
        found = evaluate(*args, **settings)
        watch.end()
        return found

    with (
        patch.object(gym.vector.SyncVectorEnv, "step", noted_step),
        patch.object(lerobot_eval, "eval_policy", noted_evaluation),
    ):
        yield watch
