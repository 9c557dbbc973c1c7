"""What training and acting share: the model, what it sees of an observation, and in which precision."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch
from lerobot.policies.common.vla_utils import pad_vector
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_LANGUAGE_ATTENTION_MASK, OBS_LANGUAGE_TOKENS, OBS_STATE
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.averaging import WeightAverage
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory.rollout import RolloutMemory
from lerobot_memobench.policies.memobench_mem.memory_pi05 import MemoryPI05
from lerobot_memobench.policies.memobench_mem.perception.objects import OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.perception.perception import Perception, Seen
from lerobot_memobench.policies.memobench_mem.precision import Precision


class SeeingPolicy(PI05Policy):
    """LeRobot's pi0.5 policy with a perception.

    Attributes:
        history: what the rows of a rollout remember.
        average: moving average of the trained weights, which evaluation uses; None before training, or without one.
        precision: that its weights are kept in.
    """

    config: MemobenchMemConfig
    model: MemoryPI05
    history: RolloutMemory
    average: WeightAverage | None
    precision: Precision

    @property
    def perception(self) -> Perception:
        """How it sees."""
        return self.model.paligemma_with_expert.perception

    @property
    def _action_dim(self) -> int:
        assert self.config.output_features is not None
        return self.config.output_features[ACTION].shape[0]

    @property
    def _device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def _remembers(self) -> bool:
        return self.history.mechanism.frames > 0

    @property
    def _seen(self) -> list[str]:
        """Observations of the present that the model is given, if they are there."""
        seen = [*self.config.image_features] if self.config.sees_pictures else []
        own = [OBS_ENV_STATE, OBS_RAW_STATE] if self.config.sees_objects else []
        return [*seen, *own, OBS_STATE, OBS_LANGUAGE_TOKENS, OBS_LANGUAGE_ATTENTION_MASK]

    def _preprocess_images(self, batch: dict[str, Tensor]) -> Seen:
        """What the model is given in the place of images: what is seen, and the state where it has a token."""
        parts, masks = self.perception.present(batch) or super()._preprocess_images(batch)
        if self.config.state_token:
            state = pad_vector(batch[OBS_STATE], self.config.max_state_dim)
            parts, masks = [*parts, state], [*masks, torch.ones(len(state), dtype=torch.bool)]
        return [part.to(self._device) for part in parts], [mask.to(self._device) for mask in masks]

    @contextlib.contextmanager
    def _acting(self) -> Iterator[None]:
        """Compute as the checkpoint of this moment would: by the average, in the precision that it is loaded in."""
        wide = self.precision.narrowed()
        average = contextlib.nullcontext() if self.average is None else self.average.applied(wide)
        with average, self.precision.computing(self._device):
            yield
