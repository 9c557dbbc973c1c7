"""What policies without weights share: the expert, the random policy, one in a server.

Apart from the configurations, which are imported whenever LeRobot starts.
"""

from __future__ import annotations

from typing import Any, ClassVar

from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.baselines.configuration_baselines import UntrainedConfig


class UntrainedPolicy(PreTrainedPolicy):
    """Answers to what LeRobot asks every policy, of one that only acts; a subclass names itself and acts."""

    config_class = UntrainedConfig
    name = "untrained"
    why_not_trained: ClassVar[str] = "has no parameters and cannot be trained"

    def get_optim_params(self) -> list[nn.Parameter]:
        """Return nothing to optimise."""
        return []

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        """Refuse to train."""
        raise MemobenchError(
            f"The policy '{self.name}' {self.why_not_trained}; choose a learning policy, for example "
            "--policy.type=memobench_mem."
        )

    def needs_observation(self) -> bool:
        """Whether it looks at the pictures of the next observation: one that only acts by other signals never does."""
        return False

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return one step at a time, so the chunk is (B, 1, 7)."""
        return self.select_action(batch).unsqueeze(1)
