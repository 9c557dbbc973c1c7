"""The robot's state in metres and radians, beside the normalised one: places of objects are told from the hand."""

from __future__ import annotations

from dataclasses import dataclass

from lerobot.configs import PipelineFeatureType, PolicyFeature
from lerobot.processor import ObservationProcessorStep, ProcessorStepRegistry
from lerobot.utils.constants import OBS_STATE

from lerobot_memobench.policies.memobench_mem.perception.objects import OBS_RAW_STATE


@dataclass
@ProcessorStepRegistry.register(name="memobench_raw_state")
class RawStateProcessorStep(ObservationProcessorStep):
    """Keep the state (B, n) as it is, as ``observation.raw_state``; before it is normalised."""

    def observation(self, observation: dict) -> dict:
        """Return the observation with its state twice."""
        if OBS_STATE not in observation:
            return observation
        return observation | {OBS_RAW_STATE: observation[OBS_STATE].clone()}

    def transform_features(
        self, features: dict[PipelineFeatureType, dict[str, PolicyFeature]]
    ) -> dict[PipelineFeatureType, dict[str, PolicyFeature]]:
        """Leave the features as they are."""
        return features
