"""The policy ``fed_at_plans``: a trained policy that observes an execution at its plans alone.

It is what an evaluator makes of a policy that it calls once per plan. A strict execution has no clock, so a memory
cannot notice the omitted steps: it counts calls. Prompts are observed at every step.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from torch import Tensor

from lerobot_memobench.constants import ENDED, EXECUTION, OBS_PHASE, OBS_STEP
from lerobot_memobench.policies.baselines import UntrainedConfig, UntrainedPolicy

QUEUES: Mapping[str, Any] = {
    "memobench_mem": lambda policy: policy.rollout.envs[0].queue,
    "window": lambda policy: policy.rows[0].queue,
}
"""Type of a policy -> the planned actions of its first environment."""


@PreTrainedConfig.register_subclass("fed_at_plans")
@dataclass
class FedAtPlansConfig(UntrainedConfig):
    """The policy of a checkpoint, fed at plans.

    Args:
        weights: the checkpoint's file of weights; the policy's identity in logs contains its hash.
        n_action_steps: executed actions of each plan (``replan=``).
    """

    reads_prompt: ClassVar[bool] = True

    weights: str = ""
    n_action_steps: int = 1

    def checkpoint(self) -> tuple[Path, Any]:
        """Return the checkpoint's folder and the configuration of its policy."""
        folder = Path(self.weights).parent
        config: Any = PreTrainedConfig.from_pretrained(folder)
        config.device, config.n_action_steps = self.device, self.n_action_steps
        return folder, config


class Row:
    """One environment: a policy with a history of its own, called in the prompt and at plans."""

    def __init__(self, policy: Any) -> None:
        self._policy = copy.copy(policy)  # weights are shared
        self._policy.reset()
        self.queue: deque[Tensor] = deque()
        self.ended = False

    def act(self, observation: dict[str, Any]) -> Tensor:
        """Return the next action (A,), normalised; between plans the observation is ignored."""
        self.ended = int(observation[OBS_STEP]) == ENDED
        if self.ended or not self.queue:
            action: Tensor = self._policy.select_action(observation)[0]
            if self.ended or int(observation[OBS_PHASE]) != EXECUTION:
                return action
            planned = QUEUES[self._policy.config.type](self._policy)
            self.queue.extend([action, *planned])
            planned.clear()
        return self.queue.popleft()


class FedAtPlansPolicy(UntrainedPolicy):
    """See `FedAtPlansConfig`."""

    config_class = FedAtPlansConfig
    name = "fed_at_plans"

    def __init__(self, config: FedAtPlansConfig, **kwargs: Any) -> None:
        super().__init__(config)
        folder, inner = config.checkpoint()
        self.inner = get_policy_class(inner.type).from_pretrained(folder, config=inner).eval()
        self.name = self.inner.name  # noise is seeded as for the policy itself
        self.reset()

    def reset(self) -> None:
        """Begin episodes."""
        self._rows: list[Row] = []

    def select_action(self, batch: dict[str, Any], **kwargs: Any) -> Tensor:
        """Return the next action of every environment (B, A), normalised."""
        steps = batch[OBS_STEP]
        self._rows = self._rows or [Row(self.inner) for _ in steps]
        several = {key: value for key, value in batch.items() if isinstance(value, Tensor | list)}
        ones = [{key: value[row : row + 1] for key, value in several.items()} for row in range(len(steps))]
        return torch.stack([row.act(one).to(steps.device) for row, one in zip(self._rows, ones, strict=True)])

    def needs_observation(self) -> bool:
        """Return whether an environment is in its prompt, or plans next."""
        return any(not row.queue and not row.ended for row in self._rows)

    def has_planned_action(self) -> bool:
        """Return whether all next actions are planned."""
        return not self.needs_observation()


def make_fed_at_plans_pre_post_processors(config: FedAtPlansConfig, dataset_stats: Any = None) -> tuple[Any, Any]:
    """Return the checkpoint's own processors."""
    folder, inner = config.checkpoint()
    override = {"device_processor": {"device": str(config.device)}}
    return make_pre_post_processors(inner, str(folder), preprocessor_overrides=override)
