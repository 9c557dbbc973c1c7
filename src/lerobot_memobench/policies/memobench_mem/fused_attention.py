"""Attention in one kernel, for the passes in which a policy with eyes learns.

LeRobot's pi0.5 attends by Hugging Face's ``eager_attention_forward``, which keeps a weight for each pair of tokens: of
72 samples with two pictures 56 MB in a layer, which come from the system page by page. torch's kernel keeps none and
takes a third of the time. It rounds otherwise, so what acts goes on with LeRobot's.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import scaled_dot_product_attention
from transformers.models.gemma import modeling_gemma

from lerobot_memobench.lerobot_hooks import ATTEND, hooked_for

MARK = "learns_fused"
"""Attribute of the attention modules that it is for."""


def attend_fused(model: nn.Module) -> None:
    """Let the attention of a model's layers be computed in one kernel wherever gradients are wanted, while it lives."""
    for module in model.modules():
        if isinstance(module, modeling_gemma.GemmaAttention):
            setattr(module, MARK, True)
    hooked_for(model, ATTEND, _fused)


def _fused(attend: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap transformers' attention: modules that are marked learn in one kernel."""

    @functools.wraps(attend)
    def attention(
        module: nn.Module, query: Tensor, key: Tensor, value: Tensor, mask: Tensor | None, scaling: float, **more: Any
    ) -> tuple[Tensor, Tensor | None]:
        if not (hasattr(module, MARK) and torch.is_grad_enabled()):
            weighed: tuple[Tensor, Tensor] = attend(module, query, key, value, mask, scaling, **more)
            return weighed
        key, value = (modeling_gemma.repeat_kv(kept, module.num_key_value_groups) for kept in (key, value))
        read = scaled_dot_product_attention(query, key, value, attn_mask=mask, scale=scaling)
        return read.transpose(1, 2).contiguous(), None

    return attention
