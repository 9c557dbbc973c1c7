"""Policies without weights: expert, blind routine, random actions, and their base class.

This module is separate from the configurations, which LeRobot imports at every start.
"""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import (
    MemobenchBlindConfig,
    MemobenchExpertConfig,
    MemobenchRandomConfig,
    UntrainedConfig,
)
from lerobot_memobench.protocol import ACTION_DIM


class UntrainedPolicy(PreTrainedPolicy):
    """Base class of policies that cannot be trained; a subclass has a name and ``select_action``."""

    config_class = UntrainedConfig
    name = "untrained"
    why_not_trained: ClassVar[str] = "has no parameters and cannot be trained"

    def get_optim_params(self) -> list[nn.Parameter]:
        """Return no parameters."""
        return []

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        """Refuse to train."""
        raise MemobenchError(
            f"the policy '{self.name}' {self.why_not_trained}; choose another policy, for example "
            "--policy.type=memobench_mem"
        )

    def needs_observation(self) -> bool:
        """Return whether the images of the next observation are needed: never."""
        return False

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return a chunk of one action, (B, 1, 7)."""
        return self.select_action(batch).unsqueeze(1)


class MemobenchExpertPolicy(UntrainedPolicy):
    """The scripted expert: ``select_action`` returns ``batch["observation.expert_action"]``, (B, 7) float32.

    Attributes:
        offered: name of the environment's setting and of the observation that holds the action.
    """

    config_class = MemobenchExpertConfig
    name = "memobench_expert"
    offered: ClassVar[str] = "expert_action"

    def __init__(self, config: MemobenchExpertConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config

    def reset(self) -> None:
        """Do nothing: the state of the expert is in the environment."""

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, 7) in [-1, 1] in the observation.

        Raises:
            MemobenchError: the environment was made without ``offered``.
        """
        key = f"observation.{self.offered}"
        if key not in batch:
            raise MemobenchError(
                f"the policy '{self.name}' needs '{key}' in the observation: pass --env.{self.offered}=true, or use "
                "`lerobot eval env=memobench`, which sets it"
            )
        return batch[key]


class MemobenchBlindPolicy(MemobenchExpertPolicy):
    """The published routine without memory or prompt: ``batch["observation.blind_action"]``, (B, 7)."""

    config_class = MemobenchBlindConfig
    name = "memobench_blind"
    offered: ClassVar[str] = "blind_action"


class MemobenchRandomPolicy(UntrainedPolicy):
    """Uniform random actions, the floor of every result: ``select_action`` draws (B, 7) float32 in [-1, 1].

    One generator is used for all rows and rollouts. The same command with the same batch size repeats its actions, and
    the rollouts of a run differ.
    """

    config_class = MemobenchRandomConfig
    name = "memobench_random"

    def __init__(self, config: MemobenchRandomConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config
        # Random numbers of the CPU are the same on every machine.
        self._generator = torch.Generator().manual_seed(config.seed)
        self.reset()

    def reset(self) -> None:
        """Clear the last action, so that smoothing does not carry it into the next rollout; the generator continues."""
        self._last: Tensor | None = None

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the next action (B, 7) in [-1, 1], one row per environment of ``batch``."""
        rows = next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim)
        draw = torch.rand(rows.shape[0], ACTION_DIM, generator=self._generator) * 2 - 1
        if self._last is not None and self._last.shape == draw.shape:
            draw = self.config.smoothing * self._last + (1 - self.config.smoothing) * draw
        self._last = draw
        return draw.to(rows.device)
