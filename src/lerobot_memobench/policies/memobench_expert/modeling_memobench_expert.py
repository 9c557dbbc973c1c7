"""The scripted expert as a LeRobot policy: it returns the action that the environment observed for it."""

from __future__ import annotations

from typing import Any

from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_expert.configuration_memobench_expert import MemobenchExpertConfig

EXPERT_ACTION = "observation.expert_action"


class MemobenchExpertPolicy(PreTrainedPolicy):
    """Parameter-less policy. ``select_action`` returns ``batch["observation.expert_action"]``, (B, 7) float32."""

    config_class = MemobenchExpertConfig
    name = "memobench_expert"

    def __init__(self, config: MemobenchExpertConfig, **kwargs: Any) -> None:
        super().__init__(config)
        self.config = config

    def get_optim_params(self) -> list[nn.Parameter]:
        return []

    def reset(self) -> None:
        """The expert lives in the environment, so there is no state to clear."""

    def forward(self, batch: dict[str, Tensor]) -> tuple[Tensor, dict | None]:
        raise MemobenchError(
            "The policy 'memobench_expert' has no parameters and cannot be trained; choose a learning policy, "
            "for example --policy.type=memobench_mem."
        )

    def select_action(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """Return the expert's action (B, 7) in [-1, 1] for the current observation.

        Raises:
            MemobenchError: the environment was made without ``expert_action``.
        """
        if EXPERT_ACTION not in batch:
            raise MemobenchError(
                f"The policy 'memobench_expert' found no '{EXPERT_ACTION}' in the observation: pass "
                "--env.expert_action=true, or use `lerobot eval env=memobench`, which sets it."
            )
        return batch[EXPERT_ACTION]

    def predict_action_chunk(self, batch: dict[str, Tensor], **kwargs: Any) -> Tensor:
        """The expert plans one step at a time, so its chunk is (B, 1, 7)."""
        return self.select_action(batch).unsqueeze(1)
