"""pi0.5 with a memory: an encoder makes memory tokens of the frames read, an integration lets actions read those."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.backbone import SizedPI05
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.integration.context import Context
from lerobot_memobench.policies.memobench_mem.integration.integration import Integration, Prefix
from lerobot_memobench.policies.memobench_mem.integration.modulation import Modulation
from lerobot_memobench.policies.memobench_mem.memory.registry import make_mechanism
from lerobot_memobench.policies.memobench_mem.memory.tokens import MemoryTokens

INTEGRATIONS: dict[str, type[Integration]] = {"modulation": Modulation, "context": Context}


OWN = ("memory.", "state_token.", "instruction.", "paligemma_with_expert.perception.")
"""What the names of parameters begin with that plain pi0.5 does not have; an integration has more."""


class MemoryPI05(SizedPI05):
    """pi0.5 with a memory: ``set_memory`` first, then LeRobot's ``forward`` or ``sample_actions``."""

    def __init__(self, config: MemobenchMemConfig, rtc_processor: Any = None) -> None:
        super().__init__(config, rtc_processor=rtc_processor)
        self.integration: Integration | None = None
        if config.integration == "none":
            return
        dims = config.dimensions
        mechanism = make_mechanism(config.memory, config.memory_frames)
        seeing = self.paligemma_with_expert.perception
        self.memory = seeing.memory(mechanism.encoder(seeing.dim, dims.vlm.width, seeing.grid))
        self.integration = INTEGRATIONS[config.integration](self, dims.vlm.width, dims.expert.width)

    def memory_parameters(self) -> dict[str, nn.Parameter]:
        """Every parameter that plain pi0.5 does not have, by name."""
        integration = self.integration
        return {
            name: parameter
            for name, parameter in self.named_parameters()
            if name.startswith(OWN) or (integration is not None and integration.owns(name))
        }

    def place_of(self, name: str) -> str:
        """Return the name in this model of a parameter of plain pi0.5."""
        return name if self.integration is None else self.integration.place_of(name)

    def set_memory(
        self, tokens: Tensor, steps: Tensor, frame_mask: Tensor, numbers: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Encode tokens (B, F, P, D) seen at steps (B, F) and hand them to the integration.

        Args:
            numbers: (B, F), equal where frames are; only of a perception that learns to remember, which encodes each
                once.

        Returns:
            H (B, F*P, d_m) and its mask (B, F*P), for the alignment objectives.
        """
        assert self.integration is not None  # the policy asks no plain pi0.5
        if numbers is None:
            memory = MemoryTokens(*self.memory(tokens, steps, frame_mask))
        else:
            memory = self.memory.shared(tokens, steps, frame_mask, numbers)
        self.integration.hand_over(memory)
        return memory.rows(), memory.mask

    def embed_prefix(self, images: Any, img_masks: Any, tokens: Any, masks: Any) -> Prefix:
        """LeRobot's prefix (what is seen now, language), as the integration changes it."""
        prefix: Prefix = super().embed_prefix(images, img_masks, tokens, masks)
        return prefix if self.integration is None else self.integration.prefix(prefix)
