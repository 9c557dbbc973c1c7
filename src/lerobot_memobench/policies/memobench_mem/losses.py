"""The action loss, and sums over the ranks of a distributed training.

Actions are learned by flow matching, as in pi0.5, or by regression, with the same passes of the same model. Flow
matching learns the velocity ``noise - actions`` at every time between noise and actions, and a chunk is integrated from
drawn noise. Regression learns it only at zero noise and time 1, where the velocity is minus the actions, so that one
Euler step yields the actions.

DDP averages gradients over the ranks. The functions on ranks are scaled so that this average is the gradient of the
joint batch; every rank must call them at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from einops import rearrange, reduce
from torch import Tensor
from torch.autograd.function import once_differentiable

from lerobot_memobench.policies.memobench_mem.memory.mechanism import PHASE
from lerobot_memobench.policies.memobench_mem.sizes import REGRESSION

_SMOOTH = 1e-6
"""Squared error below which the absolute error becomes quadratic: 0.001 standard deviations of an action."""


def noise_and_time(objective: str, model: Any, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return noise (B, T, A) and time (B,) at which a batch of actions (B, T, A) is learned."""
    if objective == REGRESSION:
        return torch.zeros_like(actions), actions.new_ones(actions.shape[0])
    return (
        model.sample_noise(actions.shape, actions.device),
        model.sample_time(actions.shape[0], actions.device),
    )


def losses_of(objective: str, squared: Tensor) -> Tensor:
    """Return losses (B, T, A) of squared errors of the velocity; regression adds the absolute errors.

    Absolute errors make actions exact. Squared errors train the memory, because choosing a wrong object is a large
    error in few frames. After 800 updates, 20 of 20 chosen bowls were right with both terms, 15 with squared errors
    only, and one with absolute errors only.
    """
    return squared + (squared + _SMOOTH).sqrt() if objective == REGRESSION else squared


ACTION_IS_PAD = "action_is_pad"


class ActionLoss(NamedTuple):
    """Action loss.

    Attributes:
        per_sample: (B,), 0 for samples without counted actions. mean: over samples with counted actions.
        per_dim: (A,), per dimension of an action.
    """

    per_sample: Tensor
    mean: Tensor
    per_dim: Tensor


def counted_actions(batch: Mapping[str, Tensor], losses: Tensor) -> Tensor:
    """Return a mask (B, T) of the actions that count: those of the execution, without padding.

    LeRobot pads chunks that reach beyond the end of their episode, and marks them by ``action_is_pad`` (B, T).
    """
    counted = torch.ones(losses.shape[:2], device=losses.device)
    if ACTION_IS_PAD in batch:
        counted = counted * ~batch[ACTION_IS_PAD].to(losses.device)
    if PHASE in batch:
        counted = counted * rearrange(batch[PHASE].reshape(-1).to(losses.device) != 0, "b -> b 1")
    return counted


def mean_losses(losses: Tensor, counted: Tensor) -> ActionLoss:
    """Average losses (B, T, A) over the counted actions (B, T), with equal weights.

    The average of the means of several ranks is the mean of the joint batch.
    """
    numbers = torch.stack([counted.sum(), counted.any(dim=1).sum()])
    actions, samples = mean_over_ranks(numbers).clamp(min=1.0 / world_size())
    per_sample = (reduce(losses, "b t a -> b t", "mean") * counted).sum(dim=1) * (samples / actions)
    per_dim = reduce(losses.detach() * rearrange(counted, "b t -> b t 1"), "b t a -> a", "sum") / actions
    return ActionLoss(per_sample, per_sample.sum() / samples, per_dim)


# -- ranks ------------------------------------------------------------------------------------------------------------


def world_size() -> int:
    """Return the number of processes of the training; 1 without torch.distributed."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def mean_over_ranks(value: Tensor) -> Tensor:
    """Return the mean of a number over the ranks, without gradient, as the denominator of a sum.

    Each rank's loss is its sum divided by this mean; the average of these losses is the joint sum over the joint count.
    """
    value = value.detach().clone()
    if world_size() > 1:
        dist.all_reduce(value)
    return value / world_size()


def rank_of_world() -> tuple[int, int]:
    """Return this process's rank and the number of processes of the training."""
    return (dist.get_rank(), dist.get_world_size()) if world_size() > 1 else (0, 1)


def joint(rows: Tensor) -> Tensor:
    """Return the rows (n, D) of all ranks, (sum of n, D), in the order of the ranks; n may differ, and may be 0.

    Gradients flow back to a row's rank, summed over the ranks. If each rank computes the same loss of the joint rows,
    this sum is ``world_size`` times the loss's gradient, which DDP's average corrects. A parameter on every rank (a
    temperature) gets the same gradient on all ranks.
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
