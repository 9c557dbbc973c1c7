"""Optimizer and learning-rate schedule of a training."""

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
    """Fused AdamW. Torch's default copies all trained parameters on a GPU, and takes three times as long on a CPU.

    At full size the copy takes 10.5 GiB; with it, `config=train_paper` does not fit on four GPUs of 80 GB.
    """

    def build(self, params: Iterable[nn.Parameter]) -> Optimizer:
        """Return the optimizer of these parameters."""
        learning = list(params)
        fused = all(parameter.device.type in ("cpu", "cuda") for parameter in learning) or None  # None: torch's choice
        return AdamW(learning, self.lr, self.betas, self.eps, self.weight_decay, fused=fused)


@LRSchedulerConfig.register_subclass("memobench_constant_with_warmup")
@dataclass
class WarmupFractionSchedulerConfig(LRSchedulerConfig):
    """Linear warm-up over a fraction of the updates (paper: 5 %), then constant, or a cosine down to ``final``.

    LeRobot's constant schedule takes a number of warm-up steps, which would have to change with ``--steps``.
    """

    num_warmup_steps: int | None = None
    warmup_fraction: float = 0.05
    final: float = 1.0

    def build(self, optimizer: Optimizer, num_training_steps: int) -> LambdaLR:
        """Return the schedule of a training of ``num_training_steps`` updates."""
        steps = self.num_warmup_steps
        warmup = max(1, round(self.warmup_fraction * num_training_steps) if steps is None else steps)

        def rate(step: int) -> float:
            fallen = (1 - math.cos(math.pi * min(1.0, step / num_training_steps))) / 2
            return min(1.0, (step + 1) / warmup) * (1 - (1 - self.final) * fallen)

        return LambdaLR(optimizer, rate)
