"""Losses of a training: of actions, and of the alignment of memory with text; sums over the ranks of a training.

Actions are learned by flow matching, as in pi0.5, or by regression, with the same passes of the same model. Regression
learns the velocity ``noise - actions`` only at zero noise and time 1, where it is minus the actions, so that one Euler
step yields the actions.

The alignment follows the paper's appendix: H (B, L, d_m) are memory tokens with a mask (B, L), T text embeddings of
width d_t. DDP averages gradients over the ranks. The functions on ranks are scaled so that this average is the gradient
of the joint batch; every rank must call them at the same time.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
import torch.distributed as dist
import torch.nn.functional as F
from einops import rearrange, reduce
from lerobot.policies.common.flow_matching import sample_noise, sample_time_beta
from torch import Tensor, nn
from torch.distributed.nn.functional import all_gather

from lerobot_memobench.policies.memobench_mem.memory.mechanism import PHASE, TEXT, TEXT_MASK
from lerobot_memobench.policies.memobench_mem.sizes import REGRESSION

_SMOOTH = 1e-6
"""Squared error below which the absolute error becomes quadratic: 0.001 standard deviations of an action."""


def noise_and_time(objective: str, actions: Tensor) -> tuple[Tensor, Tensor]:
    """Return noise (B, T, A) and time (B,) at which a batch of actions (B, T, A) is learned, drawn as in pi0.5."""
    if objective == REGRESSION:
        return torch.zeros_like(actions), actions.new_ones(actions.shape[0])
    noise: Tensor = sample_noise(actions.shape, actions.device)
    return noise, sample_time_beta(len(actions), actions.device, alpha=1.5, beta=1.0, scale=0.999, offset=0.001)


def losses_of(objective: str, squared: Tensor) -> Tensor:
    """Return losses (B, T, A) of squared errors of the velocity; regression adds the absolute errors.

    Absolute errors make actions exact. Squared errors train the memory, because choosing a wrong object is a large
    error in few frames. After 800 updates, 20 of 20 chosen bowls were right with both terms, 15 with squared errors
    only, and one with absolute errors only.
    """
    return squared + (squared + _SMOOTH).sqrt() if objective == REGRESSION else squared


ACTION_IS_PAD = "action_is_pad"


class ActionLoss(NamedTuple):
    """Losses over the counted actions."""

    per_sample: Tensor  # (B,), 0 for samples without counted actions
    mean: Tensor  # over samples with counted actions
    per_dim: Tensor  # (A,), per dimension of an action


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


# -- alignment of memory with text -------------------------------------------------------------------------------------


POSITIVE_SIMILARITY = 0.99  # texts more similar than this are the same subgoal
INITIAL_TEMPERATURE = 0.07


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Average ``values`` (..., N, D) over the N marked by ``mask`` (..., N); zero if none is marked."""
    weights = rearrange(mask.to(values.dtype), "... n -> ... n 1")
    return (values * weights).sum(dim=-2) / weights.sum(dim=-2).clamp(min=1.0)


def same_text(text: Tensor) -> Tensor:
    """Return which pairs of normalised text embeddings (N, d_t) are the same text, (N, N) bool."""
    return text @ text.T > POSITIVE_SIMILARITY


class Alignment(nn.Module, ABC):
    """An objective with a head ``project``, which maps memory vectors to the width of text embeddings.

    Texts are those of the samples, (B, d_t) with a mask (B,); in `FramewiseAlignment` those of frames, (B, F, d_t) and
    (B, F).
    """

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__()
        self.project = nn.Linear(memory_dim, text_dim)

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """Return the arguments of `forward` and `pairs` for a batch, without samples that have no text."""
        return memory[text_mask], memory_mask[text_mask], text[text_mask]

    @abstractmethod
    def pairs(self, *usable: Tensor) -> tuple[Tensor, Tensor]:
        """Return memory vectors and their texts, both (N, d_t) and normalised."""

    def numbers(self) -> dict[str, float]:
        return {}


class SemanticAlignment(Alignment):
    """Cosine distance between the projected mean memory token and its text: mean of 1 - z.T over the batch."""

    def pairs(self, *usable: Tensor) -> tuple[Tensor, Tensor]:
        memory, memory_mask, text = usable
        return F.normalize(self.project(masked_mean(memory, memory_mask)), dim=-1), F.normalize(text, dim=-1)

    def forward(self, *usable: Tensor) -> Tensor:
        z, t = self.pairs(*usable)
        return (1.0 - (z * t).sum(dim=-1)).sum() / mean_over_ranks(z.new_tensor(len(z)))


class ContrastiveAlignment(SemanticAlignment):
    """Two-way retrieval within the joint batch of all ranks.

    Repeated subgoals are positives; rows of targets sum to one.
    """

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(INITIAL_TEMPERATURE)))

    def forward(self, *usable: Tensor) -> Tensor:
        z, t = map(joint, self.pairs(*usable))
        logits = z @ t.T / self.log_temperature.exp()
        positive = same_text(t).to(logits.dtype)
        target = positive / positive.sum(dim=1, keepdim=True)
        # Both directions weigh the pair (memory i, text j) by the row-normalised target, the paper's Y_ij and Y_ji.
        memory_to_text = -(target * F.log_softmax(logits, dim=1)).sum() / len(z)
        text_to_memory = -(target * F.log_softmax(logits, dim=0)).sum() / len(z)
        return 0.5 * (memory_to_text + text_to_memory)

    def numbers(self) -> dict[str, float]:
        return {"align_temperature": self.log_temperature.exp().item()}


class FramewiseAlignment(Alignment):
    """Cosine distance per remembered frame to its own text; recent frames weigh up to twice as much."""

    def __init__(self, memory_dim: int, text_dim: int, tokens_per_frame: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.tokens_per_frame = tokens_per_frame

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """Return all arguments, with texts padded to the frames of the memory; `forward` skips frames without text."""
        missing = memory.shape[1] // self.tokens_per_frame - text.shape[1]
        return memory, memory_mask, F.pad(text, (0, 0, 0, missing)), F.pad(text_mask, (0, missing))

    def _frames(self, memory: Tensor, memory_mask: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Return frame vectors (B, F, d_t), normalised, and which frames are real and have a text, (B, F)."""
        tokens = rearrange(memory, "b (f p) d -> b f p d", p=self.tokens_per_frame)
        token_mask = rearrange(memory_mask, "b (f p) -> b f p", p=self.tokens_per_frame)
        z = F.normalize(self.project(masked_mean(tokens, token_mask)), dim=-1)
        return z, token_mask.bool().any(dim=-1) & text_mask.bool()

    @staticmethod
    def weights(valid: Tensor) -> Tensor:
        """Return recency weights (B, F) of ``valid`` frames (B, F): 0.5 + 0.5 rank / max(N - 1, 1), others zero."""
        count = valid.sum(dim=1, keepdim=True)
        rank = valid.cumsum(dim=1) - 1
        return (0.5 + 0.5 * rank / (count - 1).clamp(min=1)) * valid

    def pairs(self, *usable: Tensor) -> tuple[Tensor, Tensor]:
        memory, memory_mask, text, text_mask = usable
        z, valid = self._frames(memory, memory_mask, text_mask)
        return z[valid], F.normalize(text, dim=-1)[valid]

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> Tensor:
        z, valid = self._frames(memory, memory_mask, text_mask)
        # The embedding of a frame without text may be anything, even NaN.
        text = F.normalize(torch.where(rearrange(valid, "b f -> b f 1"), text, torch.ones_like(text)), dim=-1)
        weights, least = self.weights(valid), 0.5 / world_size()
        return (weights * (1.0 - (z * text).sum(dim=-1))).sum() / mean_over_ranks(weights.sum()).clamp(min=least)


def retrieval_accuracy(memory: Tensor, text: Tensor) -> float:
    """Return the share of memory vectors (N, d_t) whose nearest text among (N, d_t) equals their own (top-1)."""
    if len(memory) == 0:
        return 0.0
    nearest_text = (memory @ text.T).argmax(dim=1)
    return float(same_text(text).gather(1, nearest_text[:, None]).float().mean())


def make_alignment(name: str, memory_dim: int, text_dim: int, tokens_per_frame: int) -> Alignment | None:
    """Build the objective ``name``; ``none`` gives None."""
    if name == "none":
        return None
    if name == "framewise":
        return FramewiseAlignment(memory_dim, text_dim, tokens_per_frame)
    return {"semantic": SemanticAlignment, "contrastive": ContrastiveAlignment}[name](memory_dim, text_dim)


def alignment_loss(
    alignment: Alignment,
    weight: float,
    batch: Mapping[str, Tensor],
    memory: Tensor,
    mask: Tensor,
    encoder: Sequence[Tensor],
) -> tuple[Tensor, dict[str, float]]:
    """Return the weighted loss (scalar) of memory tokens (B, L, d_m) and the texts of a batch, and numbers to log.

    The average of the losses of several ranks is the loss of their joint batch. There are no numbers if no sample of
    any rank has a text. The norm of the gradient of ``encoder``, the memory's parameters, is logged.
    """
    memory = memory.to(torch.float32)  # means over hundreds of tokens and cosines, under mixed precision too
    text, text_mask = batch[TEXT].to(memory), batch[TEXT_MASK].to(memory.device)
    if not bool(mean_over_ranks(text_mask.any().float())):
        # Every parameter takes part, so that distributed training has the same graph on all ranks.
        return 0.0 * torch.stack([parameter.sum() for parameter in alignment.parameters()]).sum(), {}
    usable = alignment.usable(memory, mask, text, text_mask)
    with torch.autocast(memory.device.type, enabled=False):
        loss = alignment(*usable)
    weighted = weight * loss
    logged = {"align_loss": loss.item()}
    if memory.requires_grad and torch.is_grad_enabled():
        # Cheap, and comparable with the gradient norm that LeRobot logs.
        gradients = torch.autograd.grad(weighted, list(encoder), retain_graph=True, materialize_grads=True)
        # The gradient of a rank is that of its own rows; DDP averages them.
        logged["align_grad_norm"] = mean_over_ranks(torch.cat([grad.reshape(-1) for grad in gradients])).norm().item()
    with torch.no_grad():
        logged["align_top1"] = retrieval_accuracy(*map(joint, alignment.pairs(*usable)))
    return weighted, logged | alignment.numbers()


# -- ranks ------------------------------------------------------------------------------------------------------------


def world_size() -> int:
    """Return the number of processes of the training; 1 without torch.distributed."""
    return dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1


def mean_over_ranks(value: Tensor) -> Tensor:
    """Return the mean of a number over the ranks, without gradient.

    The average of the ranks' sums, each divided by this mean, is the joint sum over the joint count.
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
    this sum is ``world_size`` times the loss's gradient, which DDP's average corrects.
    """
    if world_size() == 1:
        return rows
    counts = torch.zeros(world_size(), dtype=torch.int64, device=rows.device)
    counts[dist.get_rank()] = len(rows)
    dist.all_reduce(counts)
    padded = F.pad(rows, (0, 0, 0, int(counts.max()) - len(rows)))  # collectives want equal shapes
    parts: Sequence[Tensor] = all_gather(padded)
    return torch.cat([part[:count] for part, count in zip(parts, counts.tolist(), strict=True)])
