"""Configuration of the policy that repeats the published routine."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PreTrainedConfig

from lerobot_memobench.policies.memobench_expert.configuration_memobench_expert import MemobenchExpertConfig


@PreTrainedConfig.register_subclass("memobench_blind")
@dataclass
class MemobenchBlindConfig(MemobenchExpertConfig):
    """Nothing to choose: the action comes from the environment's routine (``--env.blind_action=true``)."""
