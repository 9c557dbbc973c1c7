"""Which actions of a batch count in the loss, and its mean over them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from einops import rearrange, reduce
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.batch import PHASE
from lerobot_memobench.policies.memobench_mem.ranks import mean_over_ranks, world_size

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
