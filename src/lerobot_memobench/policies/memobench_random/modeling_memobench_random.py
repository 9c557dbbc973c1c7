"""Uniform random actions as a LeRobot policy."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_random.configuration_memobench_random import MemobenchRandomConfig
from lerobot_memobench.policies.untrained_policy import UntrainedPolicy

ACTION_SIZE = 7


class MemobenchRandomPolicy(UntrainedPolicy):
    """Parameter-less policy. ``select_action`` draws (B, 7) float32 in [-1, 1].

    One generator, seeded once, serves all rows and rollouts: the same command with the same batch size draws the same
    actions, and no two rollouts of a run share theirs.
    """

    config_class = MemobenchRandomConfig
    name = "memobench_random"

    def __init__(self, config: MemobenchRandomConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config
        # On the CPU, whose draws are the same on every machine.
        self._generator = torch.Generator().manual_seed(config.seed)
        self.reset()

    def reset(self) -> None:
        """Forget the last action, which smoothing would carry into the next rollout; the generator goes on."""
        self._last: Tensor | None = None

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action (B, 7) in [-1, 1], one row per environment of ``batch``."""
        rows = next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim)
        draw = torch.rand(rows.shape[0], ACTION_SIZE, generator=self._generator) * 2 - 1
        if self._last is not None and self._last.shape == draw.shape:
            draw = self.config.smoothing * self._last + (1 - self.config.smoothing) * draw
        self._last = draw
        return draw.to(rows.device)
