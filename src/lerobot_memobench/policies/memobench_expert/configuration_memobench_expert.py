"""Configuration of the policy that repeats the scripted expert's action."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig


@PreTrainedConfig.register_subclass("memobench_expert")
@dataclass
class MemobenchExpertConfig(PreTrainedConfig):
    """Nothing to choose: the action comes from the environment's expert (``--env.expert_action=true``)."""

    device: str | None = "cpu"
    push_to_hub: bool = False

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
