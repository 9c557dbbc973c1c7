"""The alignment's part of a training step: its weighted loss, and numbers to log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.utils import parameters_to_vector

from lerobot_memobench.policies.memobench_mem.alignment.objectives import Alignment, retrieval_accuracy
from lerobot_memobench.policies.memobench_mem.memory.batch import TEXT, TEXT_MASK
from lerobot_memobench.policies.memobench_mem.ranks import joint, mean_over_ranks


def alignment_loss(
    alignment: Alignment,
    weight: float,
    batch: Mapping[str, Tensor],
    memory: Tensor,
    mask: Tensor,
    encoder: Sequence[Tensor],
) -> tuple[Tensor, dict[str, float]]:
    """Align memory tokens (B, L, d_m), of which ``mask`` (B, L) is real, with the texts of a batch.

    With several ranks the batch is that of all of them together, and the average of the ranks' losses is its loss.

    Args:
        encoder: parameters of what made the memory; the gradient that they get from this loss is logged.

    Returns:
        The weighted loss (scalar), and numbers to log; none where no sample of any rank has a text.
    """
    memory = memory.to(torch.float32)  # means over hundreds of tokens and cosines, under mixed precision too
    text, text_mask = batch[TEXT].to(memory), batch[TEXT_MASK].to(memory.device)
    if not bool(mean_over_ranks(text_mask.any().float())):
        # Still touch every parameter, so that distributed training sees the same graph on all ranks.
        return 0.0 * sum(parameter.sum() for parameter in alignment.parameters()), {}
    usable = alignment.usable(memory, mask, text, text_mask)
    with torch.autocast(memory.device.type, enabled=False):
        loss = alignment(*usable)
    weighted = weight * loss
    logged = {"align_loss": loss.item()}
    if memory.requires_grad and torch.is_grad_enabled():
        # Two matrix products: cheap, and comparable with the gradient norm that LeRobot logs. What had no part in this
        # batch's memory gets zeros.
        gradients = torch.autograd.grad(weighted, list(encoder), retain_graph=True, materialize_grads=True)
        # A rank's gradient is its own rows' share; DDP averages them.
        logged["align_grad_norm"] = mean_over_ranks(parameters_to_vector(gradients)).norm().item()
    with torch.no_grad():
        logged["align_top1"] = retrieval_accuracy(*map(joint, alignment.pairs(*usable)))
    return weighted, logged | alignment.numbers()
