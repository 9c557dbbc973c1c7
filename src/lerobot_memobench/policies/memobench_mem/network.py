"""pi0.5 with a memory at a chosen size: LeRobot's transformers, passes over them, and the memory mechanism.

The passes equal LeRobot's up to rounding, and skip results without use: actions among the keys of the prefix, and last
states of the prefix. Shapes: B rows, N tokens of the prefix, T of the actions, M keys, W width of the expert.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from einops import rearrange, repeat
from lerobot.policies.common.flow_matching import euler_integrate
from lerobot.policies.common.vla_utils import create_sinusoidal_pos_embedding
from lerobot.policies.pi05.modeling_pi05 import GemmaConfig, PaliGemmaWithExpertModel
from lerobot.policies.pi_gemma import PaliGemmaForConditionalGenerationWithPiGemma, PiGemmaForCausalLM
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint
from transformers.initialization import no_init_weights

from lerobot_memobench.perception.detector import load_detector
from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    TOKEN_SCALE,
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    seed_parameters,
)
from lerobot_memobench.policies.memobench_mem.fusion import (
    ContextPass,
    MemoryPass,
    ModulationPass,
    Prefix,
    attend,
    hidden,
    modulated,
    rms_norm,
    rotary,
    rotate,
    scaled_and_shifted,
)
from lerobot_memobench.policies.memobench_mem.memory.mechanism import MemoryMechanism, MemorySpec, MemoryTokens
from lerobot_memobench.policies.memobench_mem.objects import DetectionEncoder, ObjectEncoder, ObjectsFromImages
from lerobot_memobench.policies.memobench_mem.sizes import Dimensions
from lerobot_memobench.policies.memobench_mem.texts import texts_of
from lerobot_memobench.sim.object_slots import classes

FUSIONS: dict[str, type[MemoryPass]] = {"modulation": ModulationPass, "context": ContextPass}
OWN = ("state_token.", "instruction.", "paligemma_with_expert.perception.")
"""Prefixes of the names of further parameters that plain pi0.5 does not have, except for the memory's."""
PERIODS = 4e-3, 4.0
"""Shortest and longest period of the encoding of denoising time, as in pi0.5."""
ORDERED_WORDS = 48
"""Leading words of a prompt whose order the condition of the instruction depends on."""
POSITION_SCALE = 8.0
"""Initial scale of the vectors of positions; two exchanged words differ little in the mean of a whole instruction."""


class Observation(NamedTuple):
    """Inputs of a pass; in a model with a state token, the last of the ``images`` is the state (B, dim)."""

    images: list[Tensor]  # images or tokens of each part of the observation
    image_masks: list[Tensor]  # (B,) or (B, n) bool of each part, False if it is missing
    words: Tensor  # (B, n) token numbers of the instruction
    word_masks: Tensor  # (B, n) bool, False for padding


class PrefixKeys(NamedTuple):
    """The part of a prefix to which actions attend."""

    keys: list[tuple[Tensor, Tensor]]  # keys and values (B, M, d) of each layer
    bias: Tensor  # (B, 1, M), added to attention scores
    length: Tensor  # (B, 1), number of real tokens of the prefix, which is the position of the first action


class MemoryPI05(nn.Module):
    """pi0.5 at a policy's dimensions, with a memory.

    No token of the prefix attends to an action, so a pass has two parts: one over the prefix, whose keys and values are
    kept, and one over the actions for each step of denoising.

    Attributes:
        memory: the memory mechanism; None: plain pi0.5. fusion: how actions read its tokens.
        state_token: encodes the robot's state as a token; None: the text prompt spells the state.
        instruction: with a state token, maps the instruction to a condition of the action expert's norms.
    """

    def __init__(self, config: MemobenchMemConfig) -> None:
        super().__init__()
        self.config, dims = config, config.dimensions
        width, vlm_width = dims.expert.width, dims.vlm.width
        self.paligemma_with_expert: Any = make_backbone(config)
        self.action_in_proj = nn.Linear(config.max_action_dim, width)
        self.action_out_proj = nn.Linear(width, config.max_action_dim)
        self.time_mlp_in = nn.Linear(width, width)
        self.time_mlp_out = nn.Linear(width, width)
        self.state_token = StateToken(config.max_state_dim, vlm_width) if config.state_token else None
        self.instruction = InstructionCondition(vlm_width, width) if config.state_token else None
        self.memory: MemoryMechanism | None = None
        self.fusion: type[MemoryPass] = MemoryPass
        if (mechanism := config.mechanism) is None:
            return
        observations = self.paligemma_with_expert.perception
        spec = MemorySpec(
            dim=observations.dim,
            tokens=observations.tokens_per_frame,
            width=vlm_width,
            expert=width,
            grid=observations.grid,
            stride=config.memory_stride,
            subgoals=texts_of(config.subgoals or {}),
        )
        pool, settings = mechanism.make_pool(observations, spec), mechanism.Settings(**config.memory_settings)
        self.memory = mechanism(spec, pool, settings)
        self.fusion = self.memory.fusion or FUSIONS[str(config.memory_fusion)]
        self.fusion.extend(self, vlm_width, width)

    def memory_pass(self, memory: MemoryTokens | None, watched: bool = False) -> MemoryPass:
        """Begin a pass over memory tokens; None: plain pi0.5. A ``watched`` one collects attention weights."""
        return MemoryPass() if memory is None else self.fusion(self, memory, watched)

    # -- passes ------------------------------------------------------------------------------------------------------

    def embed(self, seen: Observation, memory: MemoryPass) -> Prefix:
        """Return the prefix: observation, words, and the additions of the memory."""
        words, masks = seen.words, seen.word_masks
        if self.state_token is not None or self.training:  # padding is most of a short prefix
            longest = int(masks.sum(dim=1).max())
            words, masks = words[:, :longest], masks[:, :longest]
        embedded, state, instruction = self.paligemma_with_expert.embed_language_tokens(words), None, None
        if self.state_token is None or self.instruction is None:
            parts = self._embed_images(seen.images)
        else:
            instruction = self.instruction(embedded, masks)
            *observed, numbers = seen.images
            parts = [*self._embed_images(observed), self.state_token(numbers)]
            state = sum(part.shape[1] for part in parts) - 1
        of_tokens = [
            repeat(mask, "b -> b n", n=part.shape[1]) if mask.ndim == 1 else mask
            for mask, part in zip(seen.image_masks, parts, strict=True)
        ]
        tokens = torch.cat([*(part.to(embedded.dtype) for part in parts), embedded], dim=1)
        return memory.prefix(Prefix(tokens, torch.cat([*of_tokens, masks], dim=1), instruction), state)

    def _embed_images(self, images: list[Tensor]) -> list[Tensor]:
        """Return the prefix tokens (B, n, D) of each part of the observation; parts of equal shape share one pass."""
        encode = self.paligemma_with_expert.perception.prefix
        if len({image.shape for image in images}) > 1:
            return [encode(image) for image in images]
        return [*encode(torch.cat(images)).chunk(len(images))]

    def read_prefix(self, prefix: Prefix, memory: MemoryPass) -> PrefixKeys:
        """Return each layer's keys and values of a prefix; pass the last states of `Prefix.asked` to ``memory``."""
        model = self.paligemma_with_expert.paligemma.model.language_model
        real, collected = prefix.real, memory.attention.get("prefix")
        turned = rotary(torch.cumsum(real, dim=1) - 1, model.rotary_emb.inv_freq)
        seen = real[:, None] if prefix.attends is None else prefix.attends & real[:, None]
        x, cache, last = _narrowed(prefix.tokens, model), [], len(model.layers) - 1
        for number, layer in enumerate(model.layers):
            asked = slice(None) if number < last or collected is not None else prefix.asked
            x, *keys = self._call_layer(_prefix_layer, layer, x, turned, hidden(seen), asked, collected)
            cache.append((keys[0][:, prefix.unread :], keys[1][:, prefix.unread :]))
        if prefix.asked is not None:
            states = rms_norm(x[:, prefix.asked] if collected is not None else x)
            memory.read_out(states * (1.0 + model.norm.weight.float()))
        return PrefixKeys(cache, hidden(real[:, None, prefix.unread :]), real.sum(dim=1, keepdim=True))

    def modulations(self, time: Tensor, instruction: Tensor | None, memory: MemoryPass) -> list[Tensor]:
        """Return scale, shift and gate of each norm of the expert (..., B, 1, 3 W) at times (..., B) of denoising."""
        width = self.action_in_proj.out_features
        waves = create_sinusoidal_pos_embedding(time.flatten(), width, *PERIODS, device=time.device)
        condition = F.silu(self.time_mlp_out(F.silu(self.time_mlp_in(waves.to(time.dtype))))).unflatten(0, time.shape)
        if instruction is not None:
            condition = condition + instruction
        condition = memory.condition(condition)
        return [norm.dense(condition).unsqueeze(-2) for norm in adaptive_norms(self.paligemma_with_expert)]

    def velocity(self, x: Tensor, modulations: list[Tensor], past: PrefixKeys, memory: MemoryPass) -> Tensor:
        """Return the velocity (B, T, A) of noisy actions (B, T, A), float32, given the `modulations` of the norms."""
        model = self.paligemma_with_expert.gemma_expert.model
        states = _narrowed(memory.actions(self.action_in_proj(x)), model)
        positions = past.length + torch.arange(states.shape[1], device=states.device)
        turned = rotary(positions, self.paligemma_with_expert.paligemma.model.language_model.rotary_emb.inv_freq)
        bias, norms = F.pad(past.bias, (0, states.shape[1])), iter(modulations)
        for number, (layer, keys) in enumerate(zip(model.layers, past.keys, strict=True)):
            both = next(norms), next(norms)
            states = self._call_layer(_action_layer, layer, number, states, *both, turned, keys, bias, memory)
        states = modulated(states, next(norms))[0]
        memory.expert_states(states)
        return self.action_out_proj(states[:, -self.config.chunk_size :].to(torch.float32))

    def _call_layer(self, layer: Callable[..., Any], *inputs: Any) -> Any:
        if self.config.gradient_checkpointing and self.training:
            return checkpoint(layer, *inputs, use_reentrant=False, preserve_rng_state=False)
        return layer(*inputs)

    def forward(
        self, seen: Observation, actions: Tensor, noise: Tensor, time: Tensor, memory: MemoryPass | None = None
    ) -> Tensor:
        """Return the squared errors (B, T, A) of the velocity at times (B,) between noise and actions."""
        at, memory = rearrange(time, "b -> b 1 1"), memory or MemoryPass()
        prefix = self.embed(seen, memory)
        past = self.read_prefix(prefix, memory)
        modulations = self.modulations(time, prefix.instruction, memory)
        velocity = self.velocity(at * noise + (1 - at) * actions, modulations, past, memory)
        return F.mse_loss(noise - actions, velocity, reduction="none")

    @torch.no_grad()
    def sample_actions(self, seen: Observation, noise: Tensor, memory: MemoryPass | None = None) -> Tensor:
        """Return actions (B, T, A), denoised from noise (B, T, A)."""
        steps, memory = self.config.num_inference_steps, memory or MemoryPass()
        prefix = self.embed(seen, memory)
        past = self.read_prefix(prefix, memory)
        times = 1.0 - torch.arange(steps, dtype=torch.float32, device=noise.device) / steps
        times = times[:, None].expand(-1, len(noise))
        modulations: Any = zip(*self.modulations(times, prefix.instruction, memory), strict=True)
        return euler_integrate(lambda x, time: self.velocity(x, next(modulations), past, memory), noise, steps)

    # -- parameters --------------------------------------------------------------------------------------------------

    def memory_parameters(self) -> dict[str, nn.Parameter]:
        """Return the parameters that plain pi0.5 does not have, by name."""
        memory = self.memory_names()
        return {name: tensor for name, tensor in self.named_parameters() if name.startswith(OWN) or name in memory}

    def memory_names(self) -> set[str]:
        """Return the names of the tensors of the memory and of its fusion."""
        return {name for name in self.state_dict() if name.startswith(("memory.", *self.fusion.parts))}


class StateToken(nn.Module):
    """Encode the robot's normalised state as one token."""

    def __init__(self, dim: int, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(dim, width), nn.GELU(), nn.Linear(width, width))

    def forward(self, state: Tensor) -> Tensor:
        return rearrange(self.mlp(state) * TOKEN_SCALE, "b d -> b 1 d")


class InstructionCondition(nn.Module):
    """Map the instruction to a condition of the action expert's norms, which is added to the denoising time.

    With attention only, the model has to find the single word in which two instructions differ. On six tasks, after
    2,000 updates, the loss was 2 % lower with this condition, and 28 of 30 rollouts were solved instead of 24. Each
    word is scaled by a vector of its position before the mean, so that the condition depends on the words' order. On a
    task with six orders, after 700 updates, the first drawer was right in 12 of 12 rollouts with vectors of
    `POSITION_SCALE`, in 6 with vectors of scale 1 (both: one training seed, validation seeds).
    """

    def __init__(self, words_dim: int, width: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(words_dim, width), nn.SiLU(), nn.Linear(width, width))
        # Random vectors distinguish two orders of the same words from the first update on.
        self.positions = nn.Parameter(POSITION_SCALE * torch.randn(ORDERED_WORDS, words_dim))

    def forward(self, words: Tensor, real: Tensor) -> Tensor:
        """Return the condition (B, width) of embedded words (B, n, D); ``real`` (B, n) is False for padding."""
        weights = real.unsqueeze(-1).to(words.dtype)
        ordered = min(words.shape[1], ORDERED_WORDS)
        scale = F.pad(1 + self.positions[:ordered].to(words.dtype), (0, 0, 0, words.shape[1] - ordered), value=1.0)
        mean = (words * scale * weights).sum(dim=1) / weights.sum(dim=1).clamp(min=1)
        return self.mlp(mean.to(next(self.mlp.parameters()).dtype))


# -- layers -----------------------------------------------------------------------------------------------------------


def adaptive_norms(backbone: Any) -> Iterator[Any]:
    """Yield the expert's norms in the order in which a pass applies them."""
    expert = backbone.gemma_expert.model
    for layer in expert.layers:
        yield from (layer.input_layernorm, layer.post_attention_layernorm)
    yield expert.norm


def _narrowed(x: Tensor, model: Any) -> Tensor:
    return x.to(torch.bfloat16) if model.layers[0].self_attn.q_proj.weight.dtype == torch.bfloat16 else x


def _projected(attention: Any, x: Tensor, turned: Tensor) -> Tensor:
    """Return rotated queries (B, N, H, d)."""
    query: Tensor = attention.q_proj(x).unflatten(-1, (-1, attention.head_dim))
    return rotate(query, turned.unsqueeze(-3))


def _prefix_layer(
    layer: Any, x: Tensor, turned: Tensor, bias: Tensor, asked: slice | None, collected: list[Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the next states of the ``asked`` tokens, and keys and values of all tokens."""
    attention = layer.self_attn
    normed = (rms_norm(x) * (1.0 + layer.input_layernorm.weight.float())).to(x.dtype)
    key, value = rotate(attention.k_proj(normed), turned), attention.v_proj(normed)
    if asked is None:
        return x, key, value
    query = _projected(attention, normed[:, asked], turned[:, asked])
    read = attend(query, key, value, bias if bias.shape[1] == 1 else bias[:, asked], collected)
    x = x[:, asked] + attention.o_proj(read)
    normed = (rms_norm(x) * (1.0 + layer.post_attention_layernorm.weight.float())).to(x.dtype)
    return x + layer.mlp(normed), key, value


def _action_layer(
    layer: Any,
    number: int,
    x: Tensor,
    before: Tensor,
    after: Tensor,
    turned: Tensor,
    past: tuple[Tensor, Tensor],
    bias: Tensor,
    memory: MemoryPass,
) -> Tensor:
    """Return the next states (B, T, W) of the expert's tokens, given the modulations of both norms."""
    attention, collected = layer.self_attn, memory.attention.get("actions")
    normed, gate = modulated(x, before)
    own = rotate(attention.k_proj(normed), turned), attention.v_proj(normed)
    key, value = (torch.cat([of_past, here], dim=1) for of_past, here in zip(past, own, strict=True))
    read = attention.o_proj(attend(_projected(attention, normed, turned), key, value, bias, collected))
    x = torch.addcmul(x, read, gate)
    normed = rms_norm(x)
    inputs, gate = scaled_and_shifted(normed, after)
    inputs = memory.feed_forward(number, normed, inputs)
    return torch.addcmul(x, layer.mlp(inputs.to(x.dtype)), gate.to(x.dtype))


# -- LeRobot's transformers -------------------------------------------------------------------------------------------


def make_backbone(config: MemobenchMemConfig) -> PaliGemmaWithExpertModel:
    """Build LeRobot's PaliGemma and action expert at a policy's dimensions, with an encoder of observations.

    Image tower, its projection and the language heads are frozen.
    """
    dims, image_size = config.dimensions, config.image_size[0]
    # LeRobot's constructor fixes vocabulary, image tower and widths, so it runs on the meta device, without memory.
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
    backbone.perception = _make_encoder(config, tower)
    return backbone


def _make_encoder(config: MemobenchMemConfig, vlm: Any) -> ObservationEncoder:
    width, camera, thumbnails = config.dimensions.vlm.width, config.memory_camera or "", config.remembers_thumbnails
    if config.uses_visual_encoder:
        tower = vlm.vision_tower = VisualEncoder().fold().eval().requires_grad_(False)
        vlm.multi_modal_projector = nn.Identity()
        return VisualTokenEncoder(tower, [*config.image_features], camera, width, thumbnails)
    if not config.uses_objects:
        tower, projector, cameras = vlm.vision_tower, vlm.multi_modal_projector, [*config.image_features]
        return ImageTowerEncoder(tower, projector, config.image_size, camera, cameras, thumbnails)
    vlm.vision_tower, vlm.multi_modal_projector = nn.Identity(), nn.Identity()
    config.object_classes = config.object_classes or list(classes())
    if config.detector is not None:
        # Detection noise applies to privileged object state only.
        detect = ObjectsFromImages(load_detector(config.detector))
        return DetectionEncoder(detect, config.object_classes, width, config.memory_phase)
    return ObjectEncoder(config.object_classes, width, config.detection_noise, config.memory_phase)


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


class Precision:
    """Keep trainable parameters of a bfloat16 policy in float32 and frozen ones in bfloat16, as openpi does.

    A bfloat16 weight near 1 has steps of 1/128, so updates at a learning rate of 5e-5 would round to zero. Autocast
    rounds trained weights for each pass. All weights of a policy that only acts keep LeRobot's bfloat16.
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
