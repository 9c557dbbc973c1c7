"""The learning rate of the paper's recipe, as a schedule of LeRobot's."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lerobot.optim import LRSchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


@LRSchedulerConfig.register_subclass("memobench_constant_with_warmup")
@dataclass
class WarmupFractionSchedulerConfig(LRSchedulerConfig):
    """Linear warm-up over a fraction of the run, then constant (paper: 5 %), or a cosine down to ``final`` at its end.

    LeRobot's own constant schedule counts warm-up steps, which would have to change with ``--steps``.
    """

    num_warmup_steps: int | None = None
    warmup_fraction: float = 0.05
    final: float = 1.0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return the schedule of a run of so many updates."""
        steps = self.num_warmup_steps
        warmup = max(1, round(self.warmup_fraction * num_training_steps) if steps is None else steps)

        def rate(step: int) -> float:
            fallen = (1 - math.cos(math.pi * min(1.0, step / num_training_steps))) / 2
            return min(1.0, (step + 1) / warmup) * (1 - (1 - self.final) * fallen)

        return LambdaLR(optimizer, rate)
