"""Configuration of the policy that repeats the scripted expert's action."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from lerobot.configs import PreTrainedConfig

from lerobot_memobench.envs.observations import SIMULATOR
from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig


@PreTrainedConfig.register_subclass("memobench_expert")
@dataclass
class MemobenchExpertConfig(UntrainedConfig):
    """Nothing to choose: the action comes from the environment's expert (``--env.expert_action=true``)."""

    reads_prompt: ClassVar[bool] = True
    inputs: ClassVar[tuple[str, ...]] = (SIMULATOR,)
