"""pi0.5 with a memory, at a chosen size: LeRobot's classes with our dimensions, encoders and memory.

LeRobot fixes vocabulary, image tower and widths inside constructors. These subclasses run those constructors on the
meta device (no memory, no time), and then build the few sized modules again at a policy's dimensions, so every other
attribute and every method stays LeRobot's.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable, Sequence
from copy import deepcopy
from typing import Any

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from lerobot.policies.pi05.modeling_pi05 import GemmaConfig, PaliGemmaWithExpertModel, PI05Pytorch
from lerobot.policies.pi_gemma import PaliGemmaForConditionalGenerationWithPiGemma, PiGemmaForCausalLM
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from transformers.initialization import no_init_weights
from transformers.models.gemma import modeling_gemma

from lerobot_memobench.lerobot_hooks import ATTEND, hooked_for
from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.perception.weights import load_detector
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import Dimensions, MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    LOUD,
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    seed_parameters,
)
from lerobot_memobench.policies.memobench_mem.fusion import UNREAD, Context, MemoryFusion, Modulation, Prefix, Suffix
from lerobot_memobench.policies.memobench_mem.memory import NONE, find_mechanism, read_settings
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism, MemorySpec, MemoryTokens
from lerobot_memobench.policies.memobench_mem.motion_fields import motion_field
from lerobot_memobench.policies.memobench_mem.objects import DetectionEncoder, ObjectEncoder, ObjectsFromPictures
from lerobot_memobench.policies.memobench_mem.products import exact_gradients, exact_products
from lerobot_memobench.sim.object_slots import classes

FUSIONS: dict[str, type[MemoryFusion]] = {"modulation": Modulation, "context": Context}
OWN = ("state_token.", "instruction.", "paligemma_with_expert.perception.")
"""First parts of the names of parameters that plain pi0.5 does not have, beside the memory's."""


class MemoryPI05(PI05Pytorch):
    """LeRobot's pi0.5 at a policy's dimensions, with a memory, whose tokens the fusion is handed before a pass.

    Attributes:
        memory: the memory mechanism. fusion: how actions read its tokens. None: plain pi0.5.
        state_token: of the robot's state, where it enters as numbers; None: it enters as words of the text prompt.
        instruction: with a token of the state, the condition that tells the action expert's norms the instruction.
    """

    def __init__(self, config: MemobenchMemConfig, rtc_processor: Any = None) -> None:
        with torch.device("meta"), no_init_weights():
            super().__init__(config, rtc_processor=rtc_processor)
        dims = config.dimensions
        width, vlm_width = dims.expert.width, dims.vlm.width
        self.paligemma_with_expert = SizedPaliGemmaWithExpert(config)
        self.action_in_proj = nn.Linear(config.max_action_dim, width)
        self.action_out_proj = nn.Linear(width, config.max_action_dim)
        self.time_mlp_in = nn.Linear(width, width)
        self.time_mlp_out = nn.Linear(width, width)
        self.state_token = StateToken(config.max_state_dim, vlm_width) if config.state_token else None
        self.instruction = InstructionCondition(vlm_width, width) if config.state_token else None
        self.memory: MemoryMechanism | None = None
        self.fusion: MemoryFusion | None = None
        if config.memory == NONE:
            return
        self.memory = make_memory(config, self.paligemma_with_expert.perception)
        self.fusion = (self.memory.fusion or FUSIONS[config.memory_fusion])(self, vlm_width, width)
        if config.open_gate and isinstance(self.fusion, Modulation):
            self.fusion.open_gate()
        self.paligemma_with_expert.fusion = self.fusion

    def set_memory(self, memory: MemoryTokens) -> None:
        """Let the next passes read these tokens."""
        assert self.fusion is not None  # of plain pi0.5 nobody asks it
        self.fusion.hand_over(memory)

    def embed_prefix(self, images: Any, img_masks: Any, tokens: Tensor, masks: Tensor, *histories: Any) -> Prefix:
        """Return LeRobot's prefix (observation, then words), as the fusion changes it.

        With a token of the state, the last of the ``images`` is the state (B, dim), and the masks of the others may be
        of their tokens (B, n), which LeRobot's are not. Later versions hand over states too (``histories``): none here,
        where the configuration refuses pi0.5's own memory.
        """
        place = None
        if self.state_token is None or self.instruction is None:
            prefix: Prefix = super().embed_prefix(images, img_masks, tokens, masks, *histories)
        else:
            longest = int(masks.sum(dim=1).max())  # padding would be most of so short a prefix
            words, real, _ = super().embed_prefix([], [], tokens[:, :longest], masks[:, :longest])
            self.instruction.read(words, real)
            *parts, state = images
            embedded = [*(self.paligemma_with_expert.embed_image(part) for part in parts), self.state_token(state)]
            of_tokens = [
                repeat(mask, "b -> b n", n=part.shape[1]) if mask.ndim == 1 else mask
                for mask, part in zip(img_masks, embedded, strict=True)
            ]
            place = sum(part.shape[1] for part in embedded) - 1
            real = torch.cat([*of_tokens, real], dim=1)
            prefix = (
                torch.cat([*(part.to(words.dtype) for part in embedded), words], dim=1),
                real,
                torch.zeros_like(real),
            )
        return prefix if self.fusion is None else self.fusion.prefix(prefix, place)

    def embed_suffix(self, noisy_actions: Tensor, timestep: Tensor) -> Suffix:
        """Return LeRobot's action tokens, their masks, and the condition of the norms, as the fusion changes them."""
        *tokens, condition = super().embed_suffix(noisy_actions, timestep)
        suffix: Suffix = *tokens, condition if self.instruction is None else condition + self.instruction()
        return suffix if self.fusion is None else self.fusion.suffix(suffix)

    def memory_parameters(self) -> dict[str, nn.Parameter]:
        """Return every parameter that plain pi0.5 does not have, by name."""
        memory = self.memory_names()
        return {name: one for name, one in self.named_parameters() if name.startswith(OWN) or name in memory}

    def memory_names(self) -> set[str]:
        """Return the names of the tensors of the memory and of its fusion."""
        fusion = self.fusion
        return {
            name
            for name in self.state_dict()
            if name.startswith("memory.") or (fusion is not None and fusion.owns(name))
        }

    def place_of(self, name: str) -> str:
        """Return the name in this model of a parameter of plain pi0.5."""
        return name if self.fusion is None else self.fusion.place_of(name)


def make_memory(config: MemobenchMemConfig, observations: ObservationEncoder) -> MemoryMechanism:
    """Build the memory mechanism of a policy that reads these observations."""
    mechanism, dims = find_mechanism(config.memory), config.dimensions
    spec = MemorySpec(
        dim=observations.dim,
        tokens=config.tokens_per_frame,
        width=dims.vlm.width,
        expert=dims.expert.width,
        frames=config.memory_frames,
        grid=observations.grid,
        stride=config.memory_stride,
        subgoals=config.subgoal_texts,
    )
    pool = motion_field(observations, dims.expert.width) if mechanism.asks_motion else observations.pool()
    return mechanism(spec, pool, read_settings(config.memory, config.memory_settings))


class SizedPaliGemmaWithExpert(PaliGemmaWithExpertModel):
    """LeRobot's pair of transformers at this policy's dimensions, image tower and unused heads frozen.

    Attributes:
        fusion: says which tokens attend to which, and is shown the prefix's last states; None: as in LeRobot's.
    """

    perception: ObservationEncoder
    fusion: MemoryFusion | None = None

    def __init__(self, config: MemobenchMemConfig) -> None:
        dims, image_size = config.dimensions, config.image_size[0]
        with torch.device("meta"), no_init_weights():
            super().__init__(
                GemmaConfig(**vars(dims.vlm)),
                GemmaConfig(**vars(dims.expert)),
                use_adarms=[False, True],
                precision=config.dtype,
                image_size=image_size,
                freeze_vision_encoder=True,
                train_expert_only=config.train_expert_only,
            )
            lerobots: Any = self
            vlm = _resize(lerobots.paligemma.config, dims, image_size)
            expert = deepcopy(lerobots.gemma_expert.config)
            expert.vocab_size = dims.vocabulary
        # pi0.5's weights replace all of these.
        with no_init_weights() if config.base_weights else contextlib.nullcontext():
            self.paligemma = PaliGemmaForConditionalGenerationWithPiGemma(config=vlm)
            self.gemma_expert = PiGemmaForCausalLM(config=expert)
        self.gemma_expert.model.embed_tokens = None
        self.to_bfloat16_for_selected_params(config.dtype)
        # After LeRobot's cast, which rounds what it keeps in float32 too: one tower, one cache, at every precision.
        for module in (self.paligemma.model.vision_tower, self.paligemma.model.multi_modal_projector):
            seed_parameters(module, VISION_SEED)
        self._set_requires_grad()
        self.perception = self._perception(config)

    def _perception(self, config: MemobenchMemConfig) -> ObservationEncoder:
        """Build the encoder of observations, in the place of pi0.5's image tower where it is another."""
        vlm = self.paligemma.model
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

    def _set_requires_grad(self) -> None:
        super()._set_requires_grad()
        # Cached tokens are projected ones, so the projection is frozen with the tower.
        self.paligemma.model.multi_modal_projector.requires_grad_(False)
        # pi0.5 never asks its language heads; training state for them would only fill memory.
        self.paligemma.lm_head.requires_grad_(False)
        self.gemma_expert.lm_head.requires_grad_(False)

    def forward(self, attention_mask: Tensor | None = None, *args: Any, **kwargs: Any) -> Any:
        """Return what LeRobot's does: the last states of prefix and actions, None where there is none; and a cache."""
        if self.fusion is not None and attention_mask is not None:
            attention_mask = self.fusion.attention(attention_mask)
        (prefix, actions), cache = super().forward(attention_mask, *args, **kwargs)
        if self.fusion is not None and prefix is not None:
            self.fusion.read_out(prefix)
        return [prefix, actions], cache

    def embed_image(self, image: Tensor) -> Tensor:
        """Return prefix tokens (B, n, D) of what LeRobot calls an image: one part of the observation."""
        return self.perception.prefix(image)


class StateToken(nn.Module):
    """The robot's normalised state as one token."""

    def __init__(self, dim: int, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(dim, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, state: Tensor) -> Tensor:
        """Return the token (B, 1, width) of a state (B, dim)."""
        return rearrange(self.mlp(state) * LOUD, "b d -> b 1 d")


class InstructionCondition(nn.Module):
    """The instruction's mean word, as a condition of the action expert's adaptive norms, beside the time of denoising.

    Attention alone has to find the one word that tells two tasks apart. On six tasks of one cabinet, one microwave and
    one stove, 2,000 updates, the loss was 2 % lower with it and 28 of 30 rollouts were solved, not 24 (one training
    seed, and seeds that settings may be chosen by).
    """

    def __init__(self, words_dim: int, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(words_dim, width), nn.SiLU(), nn.Linear(width, width))
        self.mean: Tensor | None = None

    def read(self, words: Tensor, real: Tensor) -> None:
        """Begin a pass with these words (B, n, D), of which ``real`` (B, n) are no padding."""
        weights = real.unsqueeze(-1).to(words.dtype)
        self.mean = (words * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)

    def forward(self) -> Tensor:
        """Return what is added to the condition (B, width)."""
        assert self.mean is not None  # it was read
        added: Tensor = self.mlp(self.mean.to(next(self.mlp.parameters()).dtype))
        return added


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


# -- precision and attention -----------------------------------------------------------------------------------------


class Precision:
    """Precision of a bfloat16 policy's parameters: what learns is kept in float32, and computed with in bfloat16.

    A bfloat16 weight near 1 has steps of 1/128, so an update at a learning rate of 5e-5 rounds to none. As pi0.5's
    reference implementation does, trained weights are float32 and autocast rounds them for each pass; frozen weights,
    and all of a policy that only acts, stay in the bfloat16 that LeRobot gives them.

    Args:
        parameters: all of the module's, as LeRobot has cast them.
    """

    def __init__(self, parameters: Sequence[nn.Parameter]) -> None:
        self._narrow = [parameter for parameter in parameters if parameter.dtype == torch.bfloat16]

    def settle(self) -> None:
        """Widen what learns to float32; narrow what does not (any more)."""
        for parameter in self._narrow:
            parameter.data = parameter.data.to(torch.float32 if parameter.requires_grad else torch.bfloat16)

    def narrowed(self) -> dict[nn.Parameter, torch.dtype]:
        """Return those that are wider now than they are in a policy that only acts, and their width there."""
        return {parameter: torch.bfloat16 for parameter in self._narrow if parameter.dtype == torch.float32}

    def computing(self, device: torch.device) -> contextlib.AbstractContextManager[object]:
        """Return the context to compute in: autocast while weights are wider than what is computed with."""
        if any(parameter.dtype == torch.float32 for parameter in self._narrow):
            return torch.autocast(device.type, dtype=torch.bfloat16)
        return contextlib.nullcontext()


MARK = "learns_fused"
"""Attribute of attention modules that compute in one kernel where gradients are wanted."""


def attend_fused(model: nn.Module) -> None:
    """Compute the attention of a model's layers in one kernel wherever gradients are wanted, while it lives.

    LeRobot's pi0.5 attends by Hugging Face's ``eager_attention_forward``, called by its name, whatever
    ``attn_implementation`` says. It keeps a weight for each pair of tokens: of 72 samples with two pictures 56 MB in a
    layer, which come from the system page by page. torch's kernel keeps none, and an update of such a policy takes 1.1
    instead of 2.0 s on one core. It rounds otherwise, so rollouts go on with LeRobot's. Its products are exact:
    rounding to bfloat16, which makes large ones quicker, makes its many small ones several times slower.
    """
    for module in model.modules():
        if isinstance(module, modeling_gemma.GemmaAttention):
            setattr(module, MARK, True)
    hooked_for(model, ATTEND, _fused)


def _fused(attend: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap transformers' attention for the modules that are marked."""

    @functools.wraps(attend)
    def attention(
        module: nn.Module, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, scaling: float, **more: Any
    ) -> tuple[Tensor, Tensor | None]:
        if not (hasattr(module, MARK) and torch.is_grad_enabled()):
            weighed: tuple[Tensor, Tensor] = attend(module, query, key, value, mask, scaling, **more)
            return weighed
        key, value = (modeling_gemma.repeat_kv(kept, module.num_key_value_groups) for kept in (key, value))
        unread = getattr(module, UNREAD, 0)
        query, mask = query[:, :, unread:], None if mask is None else mask[:, :, unread:]
        with exact_products():
            read = scaled_dot_product_attention(query, key, value, attn_mask=mask, scale=scaling)
        exact_gradients(read)
        read = read.transpose(1, 2)
        return F.pad(read, (0, 0, 0, 0, unread, 0)) if unread else read.contiguous(), None

    return attention
