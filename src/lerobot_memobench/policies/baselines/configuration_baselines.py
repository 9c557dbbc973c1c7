"""Configurations of policies without weights: expert, blind routine, random actions, and their base class."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig

from lerobot_memobench.envs.observations import SIMULATOR
from lerobot_memobench.errors import MemobenchError


@dataclass
class UntrainedConfig(PreTrainedConfig):
    """Base class of configurations of policies that cannot be trained."""

    perception: ClassVar[str] = "any"
    """Any observations are accepted (`envs.observations`), whatever features a checkpoint lists."""

    weightless: ClassVar[bool] = True
    """The policy runs no network in this process, so one core suffices (`jobs.threads`)."""

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
        """Return a preset, which LeRobot needs before it builds the policy; ``forward`` refuses to train."""
        return AdamWConfig()

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        """No schedule."""

    def validate_features(self) -> None:
        """Accept the environment's features."""


@PreTrainedConfig.register_subclass("memobench_expert")
@dataclass
class MemobenchExpertConfig(UntrainedConfig):
    """The expert has no settings; its action comes from the environment (``--env.expert_action=true``)."""

    reads_prompt: ClassVar[bool] = True
    inputs: ClassVar[tuple[str, ...]] = (SIMULATOR,)


@PreTrainedConfig.register_subclass("memobench_blind")
@dataclass
class MemobenchBlindConfig(MemobenchExpertConfig):
    """The routine has no settings; its action comes from the environment (``--env.blind_action=true``)."""


@PreTrainedConfig.register_subclass("memobench_random")
@dataclass
class MemobenchRandomConfig(UntrainedConfig):
    """Settings of random actions.

    Args:
        seed: of the policy's own generator, which is independent of LeRobot's seed and of other policies.
        smoothing: share of the last action in the next one, in [0, 1). At 0 actions are independent and the arm
            trembles in one place; towards 1 it wanders.
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
