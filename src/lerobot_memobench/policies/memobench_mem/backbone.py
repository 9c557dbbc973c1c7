"""LeRobot's pair of transformers (PaliGemma and the action expert) at the dimensions of a policy.

LeRobot fixes vocabulary, image tower and widths inside its constructor. It runs here on the meta device (no memory, no
time); the sized modules are then built at the policy's dimensions.
"""

from __future__ import annotations

import contextlib
from copy import deepcopy
from typing import Any

import torch
from lerobot.policies.pi05.modeling_pi05 import GemmaConfig, PaliGemmaWithExpertModel
from lerobot.policies.pi_gemma import PaliGemmaForConditionalGenerationWithPiGemma, PiGemmaForCausalLM
from torch import Tensor, nn
from transformers.initialization import no_init_weights

from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.perception.weights import load_detector
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import Dimensions, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    seed_parameters,
)
from lerobot_memobench.policies.memobench_mem.objects import DetectionEncoder, ObjectEncoder, ObjectsFromPictures
from lerobot_memobench.sim.object_slots import classes


def make_backbone(config: MemobenchMemConfig) -> PaliGemmaWithExpertModel:
    """Build LeRobot's module, with the encoder of observations as ``perception``.

    Image tower, its projection and the language heads are frozen.
    """
    dims, image_size = config.dimensions, config.image_size[0]
    with torch.device("meta"), no_init_weights():
        backbone: Any = PaliGemmaWithExpertModel(
            GemmaConfig(**vars(dims.vlm)),
            GemmaConfig(**vars(dims.expert)),
            use_adarms=[False, True],
            precision=config.dtype,
            image_size=image_size,
            freeze_vision_encoder=True,
            train_expert_only=config.train_expert_only,
        )
        vlm = _resize(backbone.paligemma.config, dims, image_size)
        expert = deepcopy(backbone.gemma_expert.config)
        expert.vocab_size = dims.vocabulary
    # pi0.5's weights replace all of these.
    with no_init_weights() if config.base_weights else contextlib.nullcontext():
        backbone.paligemma = PaliGemmaForConditionalGenerationWithPiGemma(config=vlm)
        backbone.gemma_expert = PiGemmaForCausalLM(config=expert)
    backbone.gemma_expert.model.embed_tokens = None
    backbone.to_bfloat16_for_selected_params(config.dtype)
    tower = backbone.paligemma.model
    # After LeRobot's cast, which rounds float32 parameters too: one tower, one cache, at every precision.
    for module in (tower.vision_tower, tower.multi_modal_projector):
        seed_parameters(module, VISION_SEED)
    backbone._set_requires_grad()
    # Cached tokens are projected ones, so the projection is frozen with the tower. pi0.5 never uses its language heads.
    for module in (tower.multi_modal_projector, backbone.paligemma.lm_head, backbone.gemma_expert.lm_head):
        module.requires_grad_(False)
    backbone.perception = _perception(config, tower)
    made: PaliGemmaWithExpertModel = backbone
    return made


def embed_images(backbone: Any, images: list[Tensor]) -> list[Tensor]:
    """Return prefix tokens (B, n, D) of each part of the observation; parts of equal shape are encoded in one batch."""
    encode = backbone.perception.prefix
    if len({image.shape for image in images}) > 1:
        return [encode(image) for image in images]
    return [*encode(torch.cat(images)).chunk(len(images))]


def _perception(config: MemobenchMemConfig, vlm: Any) -> ObservationEncoder:
    """Build the encoder of observations; one that is not pi0.5's image tower replaces it."""
    if config.uses_visual_encoder:
        # The policy loads its weights.
        tower = vlm.vision_tower = VisualEncoder(folded=True).eval().requires_grad_(False)
        vlm.multi_modal_projector = nn.Identity()
        return VisualTokenEncoder(
            tower,
            [*config.image_features],
            config.memory_camera or "",
            config.dimensions.vlm.width,
            config.remembers_thumbnails,
        )
    if not config.uses_objects:
        return ImageTowerEncoder(
            vlm.vision_tower,
            vlm.multi_modal_projector,
            config.image_size,
            config.memory_camera or "",
            config.remembers_thumbnails,
        )
    vlm.vision_tower, vlm.multi_modal_projector = nn.Identity(), nn.Identity()
    config.object_classes = config.object_classes or list(classes())
    slots = config.object_classes, config.tokens_per_frame, config.dimensions.vlm.width
    if config.detector is not None:
        # Noise is for privileged object state alone: a policy that was trained by it goes on without.
        detect = ObjectsFromPictures(load_detector(config.detector))
        return DetectionEncoder(detect, *slots, config.memory_phase)
    return ObjectEncoder(*slots, config.detection_noise, config.memory_phase)


def _resize(vlm: Any, dims: Dimensions, image_size: int) -> Any:
    """Return a copy of LeRobot's PaliGemma configuration with this size's vocabulary and image tower."""
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
