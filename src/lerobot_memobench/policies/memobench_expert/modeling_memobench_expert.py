"""The scripted expert as a LeRobot policy: it returns the action that the environment observed for it."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_expert.configuration_memobench_expert import MemobenchExpertConfig
from lerobot_memobench.policies.untrained_policy import UntrainedPolicy


class MemobenchExpertPolicy(UntrainedPolicy):
    """Parameter-less policy. ``select_action`` returns ``batch["observation.expert_action"]``, (B, 7) float32.

    Attributes:
        offered: the environment's setting, and the part of the observation, with the action.
    """

    config_class = MemobenchExpertConfig
    name = "memobench_expert"
    offered: ClassVar[str] = "expert_action"

    def __init__(self, config: MemobenchExpertConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config

    def reset(self) -> None:
        """The expert lives in the environment, so there is no state to clear."""

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the action (B, 7) in [-1, 1] that the environment offers for the current observation.

        Raises:
            MemobenchError: the environment was made without ``offered``.
        """
        key = f"observation.{self.offered}"
        if key not in batch:
            raise MemobenchError(
                f"The policy '{self.name}' found no '{key}' in the observation: pass --env.{self.offered}=true, or use "
                "`lerobot eval env=memobench`, which sets it."
            )
        return batch[key]
