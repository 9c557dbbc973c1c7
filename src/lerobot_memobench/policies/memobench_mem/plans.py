"""Planned actions of a vector environment: every row uses up its own plan, whatever the other rows do."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.perception.slots import HAND_DIM, rotation

STILL, PER_RADIAN = 0.006, 0.1
"""How little a hand or a finger may move from one plan to the next to be still, m, and what a radian counts, m."""


class RowPlans:
    """A queue of planned actions per row, and the action each row took last."""

    def __init__(self, action_dim: int) -> None:
        self.action_dim = action_dim
        self.reset()

    def reset(self) -> None:
        """Forget all plans."""
        self.queues: list[deque[Tensor]] = []
        self.last: list[Tensor] = []
        self.stood: list[Tensor | None] = []

    def resize(self, rows: int) -> None:
        """Begin anew if the number of rows is another."""
        if len(self.queues) != rows:
            self.queues = [deque() for _ in range(rows)]
            self.last = [torch.zeros(self.action_dim) for _ in range(rows)]
            self.stood = [None] * rows

    def drop(self, row: int) -> None:
        """Forget a row's plan; until it has another its action is zero."""
        self.queues[row].clear()
        self.last[row] = torch.zeros(self.action_dim)
        self.stood[row] = None

    def begin(self, row: int, plan: Tensor, count: int, state: Tensor | None = None) -> None:
        """Take the first actions of a plan (n, A) as a row's.

        Args:
            count: how many. state: the robot's (8,), as it is, m and rad; with it, a hand that stands as it stood when
                the row's last plan was made carries out the whole plan. Where each plan would do the next thing later
                than it is carried out, the hand would stand there for ever.
        """
        stands = None
        if state is not None:
            turned = rotation(state[None, 3:HAND_DIM]).flatten() * PER_RADIAN
            stands = torch.cat([state[:3], turned, state[HAND_DIM:]]).cpu()
        stood, self.stood[row] = self.stood[row], stands
        still = stands is not None and stood is not None and bool((stands - stood).abs().max() < STILL)
        self.queues[row].extend(plan if still else plan[:count])

    def wanting(self, rows: Sequence[int]) -> list[int]:
        """Return those of ``rows`` that have no plan left."""
        return [row for row in rows if not self.queues[row]]

    def step(self, rows: Sequence[int]) -> Tensor:
        """Let ``rows`` go on with their plans; return every row's action (B, A), those of others repeated."""
        for row in rows:
            self.last[row] = self.queues[row].popleft()
        return torch.stack(self.last)
