"""Configurations of policies without weights: the expert, the blind routine, random actions, and the base of all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig

from lerobot_memobench.envs.observations import SIMULATOR
from lerobot_memobench.errors import MemobenchError


@dataclass
class UntrainedConfig(PreTrainedConfig):
    """Answer what LeRobot asks every policy's configuration, for one that is never trained."""

    perception: ClassVar[str] = "any"
    """Any observations will do (`envs.observations`), also where a checkpoint lists pictures among its features."""

    weightless: ClassVar[bool] = True
    """Nothing is computed in this process that more than one core would be quicker at (`jobs.threads`)."""

    device: str | None = "cpu"
    push_to_hub: bool = False

    @property
    def observation_delta_indices(self) -> None:
        """No observations of other steps."""

    @property
    def action_delta_indices(self) -> None:
        """No actions of other steps."""

    @property
    def reward_delta_indices(self) -> None:
        """No rewards of other steps."""

    def get_optimizer_preset(self) -> AdamWConfig:
        """LeRobot asks for one before it builds the policy; ``forward`` then refuses to train."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """No schedule."""

    def validate_features(self) -> None:
        """Take the environment's features as they are."""


@PreTrainedConfig.register_subclass("memobench_expert")
@dataclass
class MemobenchExpertConfig(UntrainedConfig):
    """Nothing to choose: the action comes from the environment's expert (``--env.expert_action=true``)."""

    reads_prompt: ClassVar[bool] = True
    inputs: ClassVar[tuple[str, ...]] = (SIMULATOR,)


@PreTrainedConfig.register_subclass("memobench_blind")
@dataclass
class MemobenchBlindConfig(MemobenchExpertConfig):
    """Nothing to choose: the action comes from the environment's routine (``--env.blind_action=true``)."""


@PreTrainedConfig.register_subclass("memobench_random")
@dataclass
class MemobenchRandomConfig(UntrainedConfig):
    """Settings of random actions.

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
