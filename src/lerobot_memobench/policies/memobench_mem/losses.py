"""The action loss, and sums over the ranks of a distributed training.

Actions are learned by flow matching, as in pi0.5, or by regression, through the same passes of the same model. Flow
matching learns the velocity ``noise - actions`` at every time between the two, and a chunk follows it from drawn noise.
Regression asks at one place only, zero noise at time 1: the velocity there is minus the actions, and one Euler step
ends at them.

LeRobot trains several processes with DDP, which averages gradients over them. All that ranks count together here is
made for that average: it is then the gradient of the joint batch. Every rank must come by at the same time.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
import torch.distributed as dist
from einops import rearrange, reduce
from torch import Tensor
from torch.autograd.function import once_differentiable

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import REGRESSION
from lerobot_memobench.policies.memobench_mem.memory.mechanism import PHASE

_SMOOTH = 1e-6
"""Square of the error below which the absolute error bends into its square: 0.001 of an action's deviation."""


def noise_and_time(objective: str, model: Any, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return where a batch of actions (B, T, A) is learned: noise (B, T, A) and time (B,)."""
    if objective == REGRESSION:
        return torch.zeros_like(actions), actions.new_ones(actions.shape[0])
    return (
        model.sample_noise(actions.shape, actions.device),
        model.sample_time(actions.shape[0], actions.device),
    )


def losses_of(objective: str, squared: Tensor) -> Tensor:
    """Return losses (B, T, A) of squared errors of the velocity: themselves, and for regression absolute errors with
    them.

    Absolute errors make actions exact, and squared ones are what a memory is learned by: to have chosen another of
    three bowls is a large error in few frames. After 800 updates 20 of 20 bowls were right by both, 15 by squared
    ones, one by absolute ones.
    """
    return squared + (squared + _SMOOTH).sqrt() if objective == REGRESSION else squared


ACTION_IS_PAD = "action_is_pad"


class ActionLoss(NamedTuple):
    """Loss per sample (B,), 0 where none of its actions counts; its mean over samples that count; and per number of an
    action (A,).
    """

    per_sample: Tensor
    mean: Tensor
    per_dim: Tensor


def counted_actions(batch: Mapping[str, Tensor], losses: Tensor) -> Tensor:
    """Return (B, T) 1 for actions of a batch that count: of the execution, and no padding.

    LeRobot pads chunks that reach beyond the end of their episode, and says so by ``action_is_pad`` (B, T).
    """
    counted = torch.ones(losses.shape[:2], device=losses.device)
    if ACTION_IS_PAD in batch:
        counted = counted * ~batch[ACTION_IS_PAD].to(losses.device)
    if PHASE in batch:
        counted = counted * rearrange(batch[PHASE].reshape(-1).to(losses.device) != 0, "b -> b 1")
    return counted


def mean_losses(losses: Tensor, counted: Tensor) -> ActionLoss:
    """Mean of losses (B, T, A) over the actions that count (B, T), each of which weighs the same.

    With several ranks the average of their means is the mean of the joint batch.
    """
    numbers = torch.stack([counted.sum(), counted.any(dim=1).sum()])
    actions, samples = mean_over_ranks(numbers).clamp(min=1.0 / world_size())
    per_sample = (reduce(losses, "b t a -> b t", "mean") * counted).sum(dim=1) * (samples / actions)
    per_dim = reduce(losses.detach() * rearrange(counted, "b t -> b t 1"), "b t a -> a", "sum") / actions
    return ActionLoss(per_sample, per_sample.sum() / samples, per_dim)


# -- ranks ------------------------------------------------------------------------------------------------------------


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


def rank_of_world() -> tuple[int, int]:
    """Return this process's rank and the number of processes that train together."""
    return (dist.get_rank(), dist.get_world_size()) if world_size() > 1 else (0, 1)


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
