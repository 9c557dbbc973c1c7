"""Configuration of the policy that acts at random."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig


@PreTrainedConfig.register_subclass("memobench_random")
@dataclass
class MemobenchRandomConfig(UntrainedConfig):
    """How the actions are drawn.

    Args:
        seed: of the policy's own generator, so that LeRobot's seed and other policies' draws change nothing.
        smoothing: share of the last action kept in the next one, in [0, 1). At 0 draws are independent and the
            arm trembles about one place; towards 1 it wanders.
    """

    inputs: ClassVar[tuple[str, ...]] = ()

    seed: int = 0
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed < 0:
            raise MemobenchError(f"policy.seed is {self.seed}; expected a whole number from 0 on")
        if not 0.0 <= self.smoothing < 1.0:
            raise MemobenchError(f"policy.smoothing is {self.smoothing}; expected a number from 0 to below 1")
