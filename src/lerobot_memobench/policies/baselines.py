"""Policies without weights: the scripted expert, the published routine replayed blindly, and random actions.

LeRobot looks for a policy and its processors in the module of its configuration, with ``configuration_`` replaced in
the name; in a module of another name it finds all three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.optim import AdamWConfig, LRSchedulerConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
    make_policy_processor_pipelines,
)
from torch import Tensor, nn

from lerobot_memobench.constants import ACTION_DIM
from lerobot_memobench.envs.observations import SIMULATOR
from lerobot_memobench.errors import MemobenchError


@dataclass
class UntrainedConfig(PreTrainedConfig):
    """Base class of configurations of policies that cannot be trained."""

    perception: ClassVar[str] = "any"
    """Any observations are accepted (`envs.observations`), whatever features a checkpoint lists."""

    device: str | None = "cpu"
    push_to_hub: bool = False

    observation_delta_indices: ClassVar[None] = None
    action_delta_indices: ClassVar[None] = None
    reward_delta_indices: ClassVar[None] = None

    def get_optimizer_preset(self) -> AdamWConfig:
        return AdamWConfig()  # LeRobot needs one before it builds the policy, whose ``forward`` refuses to train

    def get_scheduler_preset(self) -> LRSchedulerConfig | None:
        return None

    def validate_features(self) -> None:
        pass  # the environment's are accepted


class UntrainedPolicy(PreTrainedPolicy):
    """Base class of policies that cannot be trained; a subclass has a name and ``select_action``."""

    config_class = UntrainedConfig
    name = "untrained"
    why_not_trained: ClassVar[str] = "has no parameters and cannot be trained"

    def get_optim_params(self) -> list[nn.Parameter]:
        return []

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        raise MemobenchError(
            f"the policy '{self.name}' {self.why_not_trained}; choose another policy, for example "
            "--policy.type=memobench_mem"
        )

    def needs_observation(self) -> bool:
        """Return whether the images of the next observation are needed: never."""
        return False

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        return self.select_action(batch).unsqueeze(1)


def make_processors(
    config: UntrainedConfig, dataset_stats: dict[str, Any] | None = None
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return pre- and postprocessor that rename, batch and move to the policy's device, without normalisation."""
    return make_policy_processor_pipelines(
        input_steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            DeviceProcessorStep(device=config.device or "cpu"),
        ],
        output_steps=[DeviceProcessorStep(device="cpu")],
    )


# --- expert and routine ---


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


class MemobenchExpertPolicy(UntrainedPolicy):
    """The scripted expert: ``select_action`` returns ``batch["observation.expert_action"]``, (B, 7) float32."""

    config_class = MemobenchExpertConfig
    name = "memobench_expert"
    offered: ClassVar[str] = "expert_action"
    """Name of the environment's setting and of the observation that holds the action."""

    def reset(self) -> None:
        pass  # the state of the expert is in the environment

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
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


# --- random actions ---


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


class MemobenchRandomPolicy(UntrainedPolicy):
    """Uniform random actions, the floor of every result: ``select_action`` draws (B, 7) float32 in [-1, 1].

    One generator draws for all rows and rollouts, so the rollouts of a run differ.
    """

    config_class = MemobenchRandomConfig
    name = "memobench_random"

    def __init__(self, config: MemobenchRandomConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self._smoothing = config.smoothing
        # Random numbers of the CPU are the same on every machine.
        self._generator = torch.Generator().manual_seed(config.seed)
        self.reset()

    def reset(self) -> None:
        self._last: Tensor | None = None  # smoothing must not carry it into the next rollout

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        rows = next(value for value in batch.values() if isinstance(value, Tensor) and value.ndim)
        draw = torch.rand(rows.shape[0], ACTION_DIM, generator=self._generator) * 2 - 1
        if self._last is not None and self._last.shape == draw.shape:
            draw = self._smoothing * self._last + (1 - self._smoothing) * draw
        self._last = draw
        return draw.to(rows.device)


make_memobench_expert_pre_post_processors = make_processors
make_memobench_blind_pre_post_processors = make_processors
make_memobench_random_pre_post_processors = make_processors
