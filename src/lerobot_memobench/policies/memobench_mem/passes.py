"""The passes of pi0.5's two transformers: one over the prefix, and one over the actions for each denoising step.

They equal LeRobot's passes up to rounding, and skip results without use: actions among the keys of the prefix, and last
states of the prefix. Shapes: B rows, N tokens of the prefix, T of the actions, M keys, W width of the expert.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.fusion import Prefix, Reading
from lerobot_memobench.policies.memobench_mem.layers import (
    attend,
    hidden,
    modulated,
    rms_norm,
    rotary,
    rotate,
    scaled_and_shifted,
)

Call = Callable[..., Any]
"""Runs a layer; with gradient checkpointing, again in the backward pass."""


class PrefixKeys(NamedTuple):
    """The part of a prefix to which actions attend.

    Attributes:
        keys: per layer, keys and values (B, M, d). bias: (B, 1, M), added to attention scores.
        length: (B, 1), number of real tokens of the prefix, which is the position of the first action.
    """

    keys: list[tuple[Tensor, Tensor]]
    bias: Tensor
    length: Tensor


def read_prefix(backbone: Any, prefix: Prefix, reading: Reading, call: Call) -> PrefixKeys:
    """Return each layer's keys and values of a prefix; pass the last states of `Prefix.asked` to ``reading``."""
    model = backbone.paligemma.model.language_model
    real, found = prefix.real, reading.attention.get("prefix")
    turned = rotary(torch.cumsum(real, dim=1) - 1, model.rotary_emb.inv_freq)
    seen = real[:, None] if prefix.attends is None else prefix.attends & real[:, None]
    x, kept, last = _narrowed(prefix.tokens, model), [], len(model.layers) - 1
    for number, layer in enumerate(model.layers):
        asked = slice(None) if number < last or found is not None else prefix.asked
        x, *keys = call(_prefix_layer, layer, x, turned, hidden(seen), asked, found)
        kept.append((keys[0][:, prefix.unread :], keys[1][:, prefix.unread :]))
    if prefix.asked is not None:
        states = rms_norm(x[:, prefix.asked] if found is not None else x)
        reading.read_out(states * (1.0 + model.norm.weight.float()))
    return PrefixKeys(kept, hidden(real[:, None, prefix.unread :]), real.sum(dim=1, keepdim=True))


def read_actions(
    backbone: Any, x: Tensor, modulations: list[Tensor], past: PrefixKeys, reading: Reading, call: Call
) -> Tensor:
    """Return the expert's last states (B, T, W) of its tokens (B, T, W), which attend to the prefix and each other.

    Args:
        modulations: scale, shift and gate (B, 1, 3 W) of each of the `adaptive_norms`.
    """
    model = backbone.gemma_expert.model
    places = past.length + torch.arange(x.shape[1], device=x.device)
    turned = rotary(places, backbone.paligemma.model.language_model.rotary_emb.inv_freq)
    bias, norms = F.pad(past.bias, (0, x.shape[1])), iter(modulations)
    x = _narrowed(x, model)
    for number, (layer, keys) in enumerate(zip(model.layers, past.keys, strict=True)):
        x = call(_action_layer, layer, number, x, next(norms), next(norms), turned, keys, bias, reading)
    return modulated(x, next(norms))[0]


def adaptive_norms(backbone: Any) -> Iterator[Any]:
    """Yield the expert's norms in the order in which a pass applies them."""
    expert = backbone.gemma_expert.model
    for layer in expert.layers:
        yield from (layer.input_layernorm, layer.post_attention_layernorm)
    yield expert.norm


def _narrowed(x: Tensor, model: Any) -> Tensor:
    """Convert tokens to bfloat16 if the weights of the layers are bfloat16."""
    return x.to(torch.bfloat16) if model.layers[0].self_attn.q_proj.weight.dtype == torch.bfloat16 else x


def _projected(attention: Any, x: Tensor, turned: Tensor) -> Tensor:
    """Return rotated queries (B, N, H, d)."""
    query: Tensor = attention.q_proj(x).unflatten(-1, (-1, attention.head_dim))
    return rotate(query, turned.unsqueeze(-3))


def _prefix_layer(
    layer: Any, x: Tensor, turned: Tensor, bias: Tensor, asked: slice | None, found: list[Tensor] | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the next states of the ``asked`` tokens, and keys and values of all tokens."""
    attention = layer.self_attn
    normed = (rms_norm(x) * (1.0 + layer.input_layernorm.weight.float())).to(x.dtype)
    key, value = rotate(attention.k_proj(normed), turned), attention.v_proj(normed)
    if asked is None:
        return x, key, value
    query = _projected(attention, normed[:, asked], turned[:, asked])
    read = attend(query, key, value, bias if bias.shape[1] == 1 else bias[:, asked], found)
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
    reading: Reading,
) -> Tensor:
    """Return the next states (B, T, W) of the expert's tokens, given the modulations of both norms."""
    attention, found = layer.self_attn, reading.attention.get("actions")
    normed, gate = modulated(x, before)
    own = rotate(attention.k_proj(normed), turned), attention.v_proj(normed)
    key, value = (torch.cat([of_past, here], dim=1) for of_past, here in zip(past, own, strict=True))
    read = attention.o_proj(attend(_projected(attention, normed, turned), key, value, bias, found))
    x = torch.addcmul(x, read, gate)
    normed = rms_norm(x)
    inputs, gate = scaled_and_shifted(normed, after)
    inputs = reading.feed_forward(number, normed, inputs)
    return torch.addcmul(x, layer.mlp(inputs.to(x.dtype)), gate.to(x.dtype))
