"""The published routine as a LeRobot policy: what a policy reaches that neither remembers nor reads."""

from __future__ import annotations

from typing import ClassVar

from lerobot_memobench.policies.memobench_blind.configuration_memobench_blind import MemobenchBlindConfig
from lerobot_memobench.policies.memobench_expert.modeling_memobench_expert import MemobenchExpertPolicy


class MemobenchBlindPolicy(MemobenchExpertPolicy):
    """Parameter-less policy. ``select_action`` returns ``batch["observation.blind_action"]``, (B, 7) float32."""

    config_class = MemobenchBlindConfig
    name = "memobench_blind"
    offered: ClassVar[str] = "blind_action"
