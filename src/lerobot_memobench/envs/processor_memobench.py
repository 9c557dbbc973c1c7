"""What LeRobot does to this environment's observations before a policy's own processors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry

from lerobot_memobench.protocol import CLOCK


@dataclass
@ProcessorStepRegistry.register(name="memobench_clock")
class ClockProcessorStep(ObservationProcessorStep):
    """Give phase and step the shape (B,) that LeRobot gives columns of one number in a training batch."""

    def observation(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return the observation, its phase and step (B,) instead of (B, 1)."""
        return {key: value.reshape(len(value)) if key in CLOCK else value for key, value in observation.items()}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features
