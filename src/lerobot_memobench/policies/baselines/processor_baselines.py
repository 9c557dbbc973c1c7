"""Processors of policies that act in the environment's units, without normalisation."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyAction,
    PolicyProcessorPipeline,
    RenameObservationsProcessorStep,
    make_policy_processor_pipelines,
)

from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig

Processors = tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]


def pass_through(device: str) -> Processors:
    """Return pre- and postprocessor that rename, batch and move to ``device``."""
    return make_policy_processor_pipelines(
        input_steps=[
            RenameObservationsProcessorStep(rename_map={}),
            AddBatchDimensionProcessorStep(),
            DeviceProcessorStep(device=device),
        ],
        output_steps=[DeviceProcessorStep(device="cpu")],
    )


def make_processors(config: UntrainedConfig, dataset_stats: dict[str, dict[str, Any]] | None = None) -> Processors:
    """Return the processors of a baseline, on its device."""
    return pass_through(config.device or "cpu")


make_memobench_expert_pre_post_processors = make_processors
make_memobench_blind_pre_post_processors = make_processors
make_memobench_random_pre_post_processors = make_processors
