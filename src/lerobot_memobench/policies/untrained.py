"""What the configurations of policies without weights share: the expert, the random policy, one in a server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig


@dataclass
class UntrainedConfig(PreTrainedConfig):
    """Answers to what LeRobot asks every policy's configuration, of one that is never trained."""

    perception: ClassVar[str] = "any"
    """Whatever is observed will do (`envs.observations`), also where a checkpoint lists pictures among its features."""

    weightless: ClassVar[bool] = True
    """Nothing is computed in this process that more than one core would be quicker at (`jobs.threads`)."""

    device: str | None = "cpu"
    push_to_hub: bool = False

    @property
    def observation_delta_indices(self) -> None:
        """No observations of other steps."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """No actions of other steps."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards of other steps."""
        return None

    def get_optimizer_preset(self) -> AdamWConfig:
        """LeRobot asks for one before it builds the policy; ``forward`` then refuses to train."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """No schedule."""
        return None

    def validate_features(self) -> None:
        """Take the environment's features as they are."""
        return None
