"""What layers of pi0.5 and of its memory are made of: norms, rotary positions, attention over one head of keys.

They equal LeRobot's to rounding, and are quicker: fewer passes over the numbers, and fewer calls. Shapes: B rows,
N queries, M keys, H heads of queries, d their width.
"""

from __future__ import annotations

import contextlib
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.products import exact_gradients, exact_products

EPS = 1e-6
FEW_KEYS = 64
"""Up to here a CPU learns quicker by scores that are kept than by torch's kernel, which keeps none."""


class _Normed(torch.autograd.Function):
    """`rms_norm` with gradients in three passes; of torch's own, on a CPU, autograd makes ten."""

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
    """Return the rotations (..., N, d / 2, 2) of positions (..., N): cosine and sine of each frequency (d / 2,)."""
    angles = positions.unsqueeze(-1).to(torch.float32) * frequencies.to(torch.float32)
    return torch.stack([angles.cos(), angles.sin()], dim=-1)


def rotate(x: Tensor, rotations: Tensor) -> Tensor:
    """Return x (..., d) turned by rotations (..., d / 2, 2): halves are paired as in Gemma.

    The two numbers of a pair come to lie next to one another, in queries as in keys, whose products stay the same: a
    product of complex numbers takes a fifth of the time on a CPU.
    """
    first, second = x.chunk(2, dim=-1)
    if x.is_cpu and not torch.compiler.is_compiling():
        turned = torch.complex(first.float(), second.float()) * torch.view_as_complex(rotations)
        return torch.view_as_real(turned).flatten(-2).to(x.dtype)
    cos, sin = rotations.to(x.dtype).unbind(-1)
    return torch.stack([first * cos - second * sin, second * cos + first * sin], dim=-1).flatten(-2)


def hidden(real: Tensor) -> Tensor:
    """Return what is added to scores, given which tokens are read (bool): 0, or very low where none is to be read."""
    return torch.where(real, 0.0, torch.finfo(torch.float32).min / 2)


def attend(query: Tensor, key: Tensor, value: Tensor, bias: Tensor, found: list[Tensor] | None = None) -> Tensor:
    """Return what queries (B, N, H, d) read of values, (B, N, H d).

    All heads share keys and values (B, M, d), so that heads are queries as well: one product for all of them.

    Args:
        bias: (B, 1, M), or (B, N, M) where queries differ, as `hidden` makes it.
        found: takes how much is read of each (B, H, N, M), where somebody looks.
    """
    rows, count, heads, width = query.shape
    flat, scale = query.reshape(rows, count * heads, width), width**-0.5
    bias = bias.to(query.dtype)
    if bias.shape[1] > 1:
        bias = bias.repeat_interleave(heads, dim=1)
    many = torch.is_grad_enabled() and key.shape[1] > FEW_KEYS
    if found is None and (query.is_cuda or many):
        exact = contextlib.nullcontext() if torch.compiler.is_compiling() else exact_products()
        mask = bias.expand(-1, count * heads, -1)[:, None]
        with exact:
            read = F.scaled_dot_product_attention(flat[:, None], key[:, None], value[:, None], mask)
        if not torch.compiler.is_compiling():
            exact_gradients(read)
        return read.view(rows, count, heads * width)
    scores = torch.baddbmm(bias, flat, key.transpose(1, 2), alpha=scale)
    weights = scores.softmax(dim=-1, dtype=torch.float32)
    if found is not None:
        found.append(weights.unflatten(1, (count, heads)).transpose(1, 2))
    return torch.bmm(weights.to(value.dtype), value).view(rows, count, heads * width)
