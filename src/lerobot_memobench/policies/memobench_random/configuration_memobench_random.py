"""Configuration of the policy that acts at random."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig

from lerobot_memobench.errors import MemobenchError


@PreTrainedConfig.register_subclass("memobench_random")
@dataclass
class MemobenchRandomConfig(PreTrainedConfig):
    """How the actions are drawn.

    Args:
        seed: of the policy's own generator, so that LeRobot's seed and other policies' draws change nothing.
        smoothing: share of the last action kept in the next one, in [0, 1). At 0 draws are independent and the
            arm trembles about one place; towards 1 it wanders.
    """

    device: str | None = "cpu"
    push_to_hub: bool = False
    seed: int = 0
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.seed < 0:
            raise MemobenchError(f"policy.seed is {self.seed}; expected a whole number from 0 on")
        if not 0.0 <= self.smoothing < 1.0:
            raise MemobenchError(f"policy.smoothing is {self.smoothing}; expected a number from 0 to below 1")

    @property
    def observation_delta_indices(self) -> None:
        return None

    @property
    def action_delta_indices(self) -> None:
        return None

    @property
    def reward_delta_indices(self) -> None:
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """LeRobot asks for one before it builds the policy; ``forward`` then refuses to train."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    def validate_features(self) -> None:
        return None
