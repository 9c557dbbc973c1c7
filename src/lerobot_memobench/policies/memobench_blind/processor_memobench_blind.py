"""The routine's actions are already in the environment's units: its processors pass everything through."""

from __future__ import annotations

from typing import Any

from lerobot_memobench.policies.memobench_blind.configuration_memobench_blind import MemobenchBlindConfig
from lerobot_memobench.policies.pass_through import Processors, pass_through


def make_memobench_blind_pre_post_processors(
    config: MemobenchBlindConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Processors:
    """Return pre- and post-processor that rename, batch and move to the device, and never normalise."""
    return pass_through(config.device or "cpu")
