"""pi0.5 at a chosen size, with memory. LeRobot's classes do the work; only dimensions and the memory are added.

LeRobot fixes vocabulary, image tower and widths inside constructors. These subclasses run those constructors on the
meta device (no memory, no time), and then build the few sized modules again at this policy's dimensions, so every
other attribute and every method stays LeRobot's.
"""

from __future__ import annotations

import hashlib
from copy import deepcopy
from functools import cached_property
from typing import Any

import torch
from lerobot.policies.common.vla_utils import resize_with_pad_torch
from lerobot.policies.pi05.modeling_pi05 import (
    GemmaConfig,
    PaliGemmaWithExpertModel,
    PI05Pytorch,
)
from lerobot.policies.pi_gemma import PaliGemmaForConditionalGenerationWithPiGemma, PiGemmaForCausalLM
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.dimensions import Dimensions, Gemma
from lerobot_memobench.policies.memobench_mem.memory import (
    MemoryEncoder,
    MemoryModulator,
    MemoryState,
    ModulatedNorm,
    pool_tokens,
)

VISION_SEED = 20_250_705  # weights of an image tower for which none were given


def _gemma(size: Gemma) -> GemmaConfig:
    return GemmaConfig(size.width, size.depth, size.mlp_dim, size.num_heads, size.num_kv_heads, size.head_dim)


def _resize(vlm: Any, dims: Dimensions, image_size: int) -> Any:
    """Copy of LeRobot's PaliGemma configuration with this size's vocabulary and image tower."""
    config = deepcopy(vlm)
    config._vocab_size = config.image_token_index = dims.vocabulary
    config.vocab_size = config.text_config.vocab_size = dims.vocabulary
    config.hidden_size = config.projection_dim = dims.vlm.width
    vision = config.vision_config
    vision.hidden_size, vision.intermediate_size = dims.vision.width, dims.vision.mlp_dim
    vision.num_hidden_layers, vision.num_attention_heads = dims.vision.depth, dims.vision.num_heads
    vision.patch_size, vision.image_size = dims.vision.patch, image_size
    vision.projection_dim = dims.vlm.width
    return config


def seed_parameters(module: nn.Module, seed: int) -> None:
    """Draw a module's weights from a fixed seed, the same on every machine: matrices ~ N(0, 1/fan_in), biases 0.

    Norm weights are one. The image tower gets these when no weights are given, so a cache made today agrees with a
    policy built tomorrow.
    """
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in sorted(module.named_parameters()):
            if parameter.is_meta:
                continue
            if parameter.ndim == 1:
                parameter.fill_(0.0 if name.endswith("bias") else 1.0)
            else:
                fan_in = parameter[0].numel()
                noise = torch.randn(parameter.shape, generator=generator) / fan_in**0.5
                parameter.copy_(noise)


def fingerprint(modules: dict[str, nn.Module]) -> str:
    """Short hash of names, shapes and values of the modules' parameters."""
    digest = hashlib.blake2b(digest_size=12)
    for prefix, module in sorted(modules.items()):
        for name, parameter in sorted(module.named_parameters()):
            digest.update(f"{prefix}.{name}{tuple(parameter.shape)}".encode())
            digest.update(parameter.detach().to("cpu", torch.float32).contiguous().numpy().tobytes())
    return digest.hexdigest()


class FrameEncoder:
    """Images to pooled memory tokens by the frozen tower. Cache and rollout both use it, so that they agree."""

    def __init__(self, tower: nn.Module, projector: nn.Module, resolution: tuple[int, int]) -> None:
        self.tower, self.projector, self.resolution = tower, projector, resolution
        self.tokens_per_frame = 16
        self.dim: int = projector.linear.out_features

    @cached_property
    def key(self) -> str:
        """Identity of the tokens this makes: weights, input size and pooling."""
        weights = fingerprint({"vision_tower": self.tower, "multi_modal_projector": self.projector})
        return f"{weights}-{self.resolution[0]}x{self.resolution[1]}-mean{self.tokens_per_frame}"

    @torch.no_grad()
    def __call__(self, images: Tensor) -> Tensor:
        """Encode images (N, 3, H, W) float in [0, 1] to (N, 16, D) bfloat16 on the tower's device."""
        device = next(self.tower.parameters()).device
        images = images.to(device, torch.float32)
        if tuple(images.shape[-2:]) != tuple(self.resolution):
            images = resize_with_pad_torch(images, *self.resolution)
        # Mixed precision would make rollout tokens differ from cached ones.
        with torch.autocast(device.type, enabled=False):
            features = self.projector(self.tower(images * 2.0 - 1.0).last_hidden_state)
        return pool_tokens(features).to(torch.bfloat16)


class SizedPaliGemmaWithExpert(PaliGemmaWithExpertModel):
    """LeRobot's pair of transformers at this policy's dimensions, image tower and unused heads frozen."""

    def __init__(self, dims: Dimensions, config: MemobenchMemConfig) -> None:
        image_size = config.image_size[0]
        with torch.device("meta"):
            super().__init__(
                _gemma(dims.vlm),
                _gemma(dims.expert),
                use_adarms=[False, True],
                precision=config.dtype,
                image_size=image_size,
                freeze_vision_encoder=config.freeze_vision_encoder,
                train_expert_only=config.train_expert_only,
            )
            lerobots: Any = self
            vlm = _resize(lerobots.paligemma.config, dims, image_size)
            expert = deepcopy(lerobots.gemma_expert.config)
            expert.vocab_size = dims.vocabulary
        self.paligemma = PaliGemmaForConditionalGenerationWithPiGemma(config=vlm)
        self.gemma_expert = PiGemmaForCausalLM(config=expert)
        self.gemma_expert.model.embed_tokens = None
        self.to_bfloat16_for_selected_params(config.dtype)
        # After LeRobot's cast, which rounds what it keeps in float32 too: one tower, one cache, at every precision.
        for module in (self.paligemma.model.vision_tower, self.paligemma.model.multi_modal_projector):
            seed_parameters(module, VISION_SEED)
        self._set_requires_grad()

    def _set_requires_grad(self) -> None:
        super()._set_requires_grad()
        if self.freeze_vision_encoder:
            # Cached tokens are projected ones, so the projection is frozen with the tower.
            self.paligemma.model.multi_modal_projector.requires_grad_(False)
        # pi0.5 never asks its language heads; training state for them would only fill memory.
        self.paligemma.lm_head.requires_grad_(False)
        self.gemma_expert.lm_head.requires_grad_(False)

    def frame_encoder(self, resolution: tuple[int, int]) -> FrameEncoder:
        """The encoder of memory frames that shares this model's tower."""
        model = self.paligemma.model
        return FrameEncoder(model.vision_tower, model.multi_modal_projector, resolution)


class SizedPI05(PI05Pytorch):
    """LeRobot's pi0.5 model at this policy's dimensions; nothing else differs."""

    def __init__(self, config: MemobenchMemConfig, rtc_processor: Any = None) -> None:
        with torch.device("meta"):
            super().__init__(config, rtc_processor=rtc_processor)
        dims = config.dimensions
        width = dims.expert.width
        self.paligemma_with_expert = SizedPaliGemmaWithExpert(dims, config)
        self.action_in_proj = nn.Linear(config.max_action_dim, width)
        self.action_out_proj = nn.Linear(width, config.max_action_dim)
        self.time_mlp_in = nn.Linear(width, width)
        self.time_mlp_out = nn.Linear(width, width)


class MemoryPI05(SizedPI05):
    """pi0.5 with a memory: ``set_memory`` first, then LeRobot's ``forward`` or ``sample_actions``."""

    def __init__(self, config: MemobenchMemConfig, rtc_processor: Any = None) -> None:
        super().__init__(config, rtc_processor=rtc_processor)
        dims = config.dimensions
        self.memory_state = MemoryState()
        self.context: tuple[Tensor, Tensor] | None = None
        if config.integration == "none":
            return
        self.memory = MemoryEncoder(image_dim=dims.vlm.width, memory_dim=dims.vlm.width)
        if config.integration == "modulation":
            self.memory_to_expert = nn.Linear(dims.vlm.width, dims.expert.width)
            for layer in self.paligemma_with_expert.gemma_expert.model.layers:
                layer.post_attention_layernorm = ModulatedNorm(
                    layer.post_attention_layernorm, MemoryModulator(dims.expert.width), self.memory_state
                )

    def memory_parameters(self) -> dict[str, nn.Parameter]:
        """Every parameter that plain pi0.5 does not have, by name."""
        return {
            name: parameter
            for name, parameter in self.named_parameters()
            if name.startswith(("memory.", "memory_to_expert.")) or ".modulator." in name
        }

    def set_memory(self, tokens: Tensor, steps: Tensor, frame_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Encode tokens (B, F, P, D) seen at steps (B, F) and hand them to the layers that read memory.

        Returns:
            H (B, F*P, d_m) and its mask (B, F*P), for the alignment objectives.
        """
        memory, mask = self.memory(tokens, steps, frame_mask)
        if self.config.integration == "modulation":
            self.memory_state.set(self.memory_to_expert(memory), mask)
        else:
            self.context = memory, mask
        return memory, mask

    def embed_prefix(self, images: Any, img_masks: Any, tokens: Any, masks: Any) -> tuple[Tensor, Tensor, Tensor]:
        """LeRobot's prefix (images, language), followed by the memory tokens with ``integration=context``."""
        embeddings, pad_masks, attention_masks = super().embed_prefix(images, img_masks, tokens, masks)
        if self.context is None:
            return embeddings, pad_masks, attention_masks
        memory, mask = self.context
        return (
            torch.cat([embeddings, memory.to(embeddings.dtype)], dim=1),
            torch.cat([pad_masks, mask], dim=1),
            torch.cat([attention_masks, torch.zeros_like(mask)], dim=1),
        )
