"""Processors of the remote policy; the server normalises its inputs and outputs."""

from __future__ import annotations

from typing import Any

from lerobot_memobench.policies.baselines.processor_baselines import Processors, pass_through
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig


def make_memobench_remote_pre_post_processors(
    config: RemoteConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> Processors:
    """Return pre- and postprocessor that rename and batch only; images stay on the CPU."""
    return pass_through("cpu")
