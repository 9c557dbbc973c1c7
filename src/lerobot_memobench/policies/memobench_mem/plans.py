"""Planned actions of a vector environment: every row uses up its own plan, whatever the other rows do."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import torch
from torch import Tensor


class RowPlans:
    """A queue of planned actions per row, and the action each row took last."""

    def __init__(self, action_dim: int) -> None:
        self.action_dim = action_dim
        self.reset()

    def reset(self) -> None:
        """Forget all plans."""
        self.queues: list[deque[Tensor]] = []
        self.last: list[Tensor] = []

    def resize(self, rows: int) -> None:
        """Begin anew if the number of rows is another."""
        if len(self.queues) != rows:
            self.queues = [deque() for _ in range(rows)]
            self.last = [torch.zeros(self.action_dim) for _ in range(rows)]

    def drop(self, row: int) -> None:
        """Forget a row's plan; until it has another its action is zero."""
        self.queues[row].clear()
        self.last[row] = torch.zeros(self.action_dim)

    def wanting(self, rows: Sequence[int]) -> list[int]:
        """Return those of ``rows`` that have no plan left."""
        return [row for row in rows if not self.queues[row]]

    def step(self, rows: Sequence[int]) -> Tensor:
        """Let ``rows`` go on with their plans; return every row's action (B, A), those of others repeated."""
        for row in rows:
            self.last[row] = self.queues[row].popleft()
        return torch.stack(self.last)
