"""What the ranks of a distributed run count together, so that a batch shared among them is one batch.

LeRobot trains several processes with DDP, which averages gradients over them. All here is made for that average: it
is then the gradient of the joint batch, and no factor is left to anybody else. Every rank must come by at the same
time; with one process nothing is done.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor
from torch.autograd.function import once_differentiable


def world_size() -> int:
    """Return how many processes train together; 1 where none were started."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def mean_over_ranks(value: Tensor) -> Tensor:
    """Return the mean of a number over the ranks, without gradient: a sum's denominator.

    A rank's sum over this is its loss; the average of those losses is the joint sum over the joint count.
    """
    value = value.detach().clone()
    if world_size() > 1:
        dist.all_reduce(value)
    return value / world_size()


def means_over_ranks(numbers: Mapping[str, Any], device: torch.device | str = "cpu") -> dict[str, Any]:
    """Return the same with each float's mean over the ranks, all of which name the same ones."""
    if world_size() == 1:
        return dict(numbers)
    floats = [name for name, value in numbers.items() if isinstance(value, float)]
    means = mean_over_ranks(torch.tensor([numbers[name] for name in floats], device=device))
    return {**numbers, **dict(zip(floats, means.tolist(), strict=True))}


def joint(rows: Tensor) -> Tensor:
    """Return the rows (n, D) of all ranks, (sum of n, D), in the order of the ranks; n may differ, and may be 0.

    Gradients flow back to the rank that a row came from, summed over the ranks. Where each rank computes the same loss
    of the joint rows, that is ``world_size`` times the loss's gradient, which DDP's average makes right again; what
    every rank holds itself (a temperature) gets the same gradient everywhere and keeps it.
    """
    if world_size() == 1:
        return rows
    counts = torch.zeros(world_size(), dtype=torch.int64, device=rows.device)
    counts[dist.get_rank()] = len(rows)
    dist.all_reduce(counts)
    gathered: Tensor = _Gather.apply(rows, counts.tolist())
    return gathered


class _Gather(torch.autograd.Function):
    """All-gather of rows of known counts; backward is its transpose, a sum over ranks."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, counts: list[int]) -> Tensor:
        first = sum(counts[: dist.get_rank()])
        ctx.own = slice(first, first + len(rows))
        # Collectives want equal shapes.
        padded = rows.new_zeros(max(counts), *rows.shape[1:])
        padded[: len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in counts]
        dist.all_gather(parts, padded)
        return torch.cat([part[:count] for part, count in zip(parts, counts, strict=True)])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        gradient = gradient.contiguous().clone()
        dist.all_reduce(gradient)
        return gradient[ctx.own], None
