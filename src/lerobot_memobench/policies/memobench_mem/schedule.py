"""The optimizer and the learning rate of the paper's recipe, as LeRobot's."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

from lerobot.optim import AdamWConfig, LRSchedulerConfig, OptimizerConfig
from torch import nn
from torch.optim import AdamW, Optimizer
from torch.optim.lr_scheduler import LambdaLR


@OptimizerConfig.register_subclass("memobench_adamw")
@dataclass
class FusedAdamWConfig(AdamWConfig):
    """AdamW that needs no room beside its state on a GPU, where torch's default makes a copy of all that learns.

    At full size that copy is 10.5 GiB, and is what made four cards of 80 GB too small for `config=train_paper`.
    """

    def build(self, params: Iterable[nn.Parameter]) -> Optimizer:
        """Return the optimizer of some parameters."""
        learning = list(params)
        fused = all(parameter.is_cuda for parameter in learning) or None  # elsewhere torch's own choice
        return AdamW(learning, self.lr, self.betas, self.eps, self.weight_decay, fused=fused)


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
