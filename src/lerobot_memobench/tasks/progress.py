"""How far an execution has come: which checkpoints were satisfied when, and whether the goal holds."""

from __future__ import annotations

from collections.abc import Callable

from lerobot_memobench.tasks.evaluator import Evaluator
from lerobot_memobench.tasks.formula import Atom
from lerobot_memobench.tasks.task import Task


class Progress:
    """Follows one episode's execution phase; call ``step`` exactly once per control step.

    Attributes (steps are counted from 1; None until it happens; K checkpoints):
        steps: control steps taken since ``reset``.
        success: the goal holds now.
        satisfied: (K,) the checkpoint's predicate holds now.
        first_step: (K,) first step at which the predicate held.
        ordered_step: (K,) first step at which it held with all earlier checkpoints complete in order; several
            may complete in one step.
        index: number of checkpoints completed in order so far.
    """

    def __init__(self, task: Task) -> None:
        self.task = task
        self._evaluator = Evaluator([task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)])
        self.reset()

    def reset(self) -> None:
        """Forget everything: the execution starts anew."""
        self._evaluator.reset()
        count = len(self.task.checkpoints)
        self.steps = 0
        self.success = False
        self.satisfied: tuple[bool, ...] = (False,) * count
        self.first_step: list[int | None] = [None] * count
        self.ordered_step: list[int | None] = [None] * count
        self.index = 0

    @property
    def lost(self) -> bool:
        """The goal can no longer be reached, whatever is done."""
        return self._evaluator.settled[0] is False

    def step(self, holds: Callable[[Atom], bool]) -> bool:
        """Take in the state after one control step, answered by ``holds``; return ``success``."""
        self.steps += 1
        self.success, *satisfied = self._evaluator.step(holds)
        self.satisfied = tuple(satisfied)
        for k, now in enumerate(satisfied):
            if now and self.first_step[k] is None:
                self.first_step[k] = self.steps
        while self.index < len(satisfied) and satisfied[self.index]:
            self.ordered_step[self.index] = self.steps
            self.index += 1
        return self.success
