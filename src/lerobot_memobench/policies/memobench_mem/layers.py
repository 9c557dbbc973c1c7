"""Operations of pi0.5's layers and of its memory: norms, rotary positions, attention over one head of keys.

They equal LeRobot's up to rounding and are faster. Shapes: B rows, N queries, M keys, H heads of queries of width d.
"""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

EPS = 1e-6
FEW_KEYS = 64
"""Up to this number of keys, attention with stored scores trains faster on a CPU than torch's fused kernel."""


class _Normed(torch.autograd.Function):
    """`rms_norm` whose gradient takes three passes over the numbers; torch's own takes ten on a CPU."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        inverse = torch.linalg.vector_norm(x, dim=-1, keepdim=True).square_().div_(x.shape[-1]).add_(EPS).rsqrt_()
        normed = x * inverse
        ctx.save_for_backward(normed, inverse)
        return normed

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (gradient,), (normed, inverse) = gradients, ctx.saved_tensors
        along = torch.linalg.vecdot(gradient, normed).div_(normed.shape[-1]).unsqueeze_(-1)
        return torch.addcmul(gradient, normed, along, value=-1).mul_(inverse)


def rms_norm(x: Tensor) -> Tensor:
    """Return x (..., W) with a mean square of one, in float32."""
    x = x.to(torch.float32)
    if x.is_cpu and torch.is_grad_enabled() and not torch.compiler.is_compiling():
        normed: Tensor = _Normed.apply(x)
        return normed
    return F.rms_norm(x, x.shape[-1:], eps=EPS)


def scaled_and_shifted(normed: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
    """Return normed (B, N, W) scaled and shifted, and the gate (B, 1, W), by scale, shift and gate (B, 1, 3 W)."""
    scale, shift, gate = modulation.chunk(3, dim=-1)
    return torch.addcmul(shift.float(), normed, 1 + scale.float()), gate


def modulated(x: Tensor, modulation: Tensor) -> tuple[Tensor, Tensor]:
    """Return the adaptive norm of x (B, N, W), given scale, shift and gate (B, 1, 3 W), and the gate (B, 1, W)."""
    normed, gate = scaled_and_shifted(rms_norm(x), modulation)
    return normed.to(x.dtype), gate.to(x.dtype)


def rotary(positions: Tensor, frequencies: Tensor) -> Tensor:
    """Return cosine and sine (..., N, d / 2, 2) of positions (..., N) at each frequency (d / 2,)."""
    angles = positions.unsqueeze(-1).to(torch.float32) * frequencies.to(torch.float32)
    return torch.stack([angles.cos(), angles.sin()], dim=-1)


def rotate(x: Tensor, rotations: Tensor) -> Tensor:
    """Return x (..., d) rotated by cosines and sines (..., d / 2, 2); halves are paired as in Gemma.

    The result interleaves the two numbers of each pair, in queries and keys alike, so that their products stay the
    same. Complex multiplication then takes a fifth of the time on a CPU.
    """
    first, second = x.chunk(2, dim=-1)
    if x.is_cpu and not torch.compiler.is_compiling():
        turned = torch.complex(first.float(), second.float()) * torch.view_as_complex(rotations)
        return torch.view_as_real(turned).flatten(-2).to(x.dtype)
    cos, sin = rotations.to(x.dtype).unbind(-1)
    return torch.stack([first * cos - second * sin, second * cos + first * sin], dim=-1).flatten(-2)


def hidden(real: Tensor) -> Tensor:
    """Return the bias of attention scores: 0 for tokens that are read (``real``), very low for all others."""
    return torch.where(real, 0.0, torch.finfo(torch.float32).min / 2)


def attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor, found: list[Tensor] | None = None) -> Tensor:
    """Return the attention output (B, N, H d) of queries (B, N, H, d) over keys and values (B, M, d).

    All heads share keys and values, so heads are computed as further queries in one product.

    Args:
        bias: (B, 1, M), or (B, N, M) if it differs between queries, as of `hidden`.
        found: a list to which the attention weights (B, H, N, M) are appended.
    """
    rows, count, heads, width = query.shape
    flat, scale = query.reshape(rows, count * heads, width), width**-0.5
    bias = bias.to(query.dtype)
    if bias.shape[1] > 1:
        bias = bias.repeat_interleave(heads, dim=1)
    many = torch.is_grad_enabled() and key.shape[1] > FEW_KEYS
    if found is None and (query.is_cuda or many):
        mask = bias.expand(-1, count * heads, -1)[:, None]
        read = F.scaled_dot_product_attention(flat[:, None], key[:, None], value[:, None], mask)
        return read.view(rows, count, heads * width)
    scores = torch.baddbmm(bias, flat, key.transpose(1, 2), alpha=scale)
    weights = scores.softmax(dim=-1, dtype=torch.float32)
    if found is not None:
        found.append(weights.unflatten(1, (count, heads)).transpose(1, 2))
    return torch.bmm(weights.to(value.dtype), value).view(rows, count, heads * width)
