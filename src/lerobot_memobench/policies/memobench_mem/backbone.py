"""LeRobot's two transformers (PaliGemma and the action expert) at the dimensions of a policy, and their precision.

LeRobot fixes vocabulary, image tower and widths in its constructor. The constructor runs here on the meta device, which
takes no memory and no time; the modules are then built at the policy's dimensions.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from lerobot.policies.pi05.modeling_pi05 import GemmaConfig, PaliGemmaWithExpertModel
from lerobot.policies.pi_gemma import PaliGemmaForConditionalGenerationWithPiGemma, PiGemmaForCausalLM
from torch import Tensor, nn
from transformers.initialization import no_init_weights

from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.perception.weights import load_detector
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    seed_parameters,
)
from lerobot_memobench.policies.memobench_mem.objects import DetectionEncoder, ObjectEncoder, ObjectsFromPictures
from lerobot_memobench.policies.memobench_mem.sizes import Dimensions
from lerobot_memobench.sim.object_slots import classes


class Precision:
    """Keep trainable parameters of a bfloat16 policy in float32 and frozen ones in bfloat16.

    A bfloat16 weight near 1 has steps of 1/128, so updates at a learning rate of 5e-5 would round to zero. As in the
    reference implementation of pi0.5, trained weights are float32 and autocast rounds them for each pass. Frozen
    weights, and all weights of a policy that only acts, keep LeRobot's bfloat16.

    Args:
        parameters: all of the module's, as cast by LeRobot.
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._narrow = [parameter for parameter in parameters if parameter.dtype == torch.bfloat16]

    def settle(self) -> None:
        """Convert trainable parameters to float32 and frozen ones to bfloat16."""
        for parameter in self._narrow:
            parameter.data = parameter.data.to(torch.float32 if parameter.requires_grad else torch.bfloat16)

    def narrowed(self) -> dict[nn.Parameter, torch.dtype]:
        """Return the parameters that are float32 now and bfloat16 in a policy that only acts, with that type."""
        return {parameter: torch.bfloat16 for parameter in self._narrow if parameter.dtype == torch.float32}

    def computing(self, device: torch.device) -> contextlib.AbstractContextManager[object]:
        """Return the context of a pass: autocast to bfloat16 if weights are float32."""
        if any(parameter.dtype == torch.float32 for parameter in self._narrow):
            return torch.autocast(device.type, dtype=torch.bfloat16)
        return contextlib.nullcontext()


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
    # Loading pi0.5's weights replaces all of these.
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
    # Cached tokens are projected, so the projection is frozen with the tower. pi0.5 does not use its language heads.
    for module in (tower.multi_modal_projector, backbone.paligemma.lm_head, backbone.gemma_expert.lm_head):
        module.requires_grad_(False)
    backbone.perception = _perception(config, tower)
    made: PaliGemmaWithExpertModel = backbone
    return made


def embed_images(backbone: Any, images: list[Tensor]) -> list[Tensor]:
    """Return the prefix tokens (B, n, D) of each part of the observation; parts of equal shape share one pass."""
    encode = backbone.perception.prefix
    if len({image.shape for image in images}) > 1:
        return [encode(image) for image in images]
    return [*encode(torch.cat(images)).chunk(len(images))]


def _perception(config: MemobenchMemConfig, vlm: Any) -> ObservationEncoder:
    """Build the encoder of observations; another encoder than pi0.5's image tower replaces the tower."""
    if config.uses_visual_encoder:
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
    slots = config.object_classes, config.dimensions.vlm.width
    if config.detector is not None:
        # Detection noise applies to privileged object state only.
        detect = ObjectsFromPictures(load_detector(config.detector))
        return DetectionEncoder(detect, *slots, config.memory_phase)
    return ObjectEncoder(*slots, config.detection_noise, config.memory_phase)


def _resize(vlm: Any, dims: Dimensions, image_size: int) -> Any:
    """Return a copy of LeRobot's PaliGemma configuration with the vocabulary and image tower of ``dims``."""
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
