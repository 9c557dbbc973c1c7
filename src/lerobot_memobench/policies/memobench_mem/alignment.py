"""Alignment of memory tokens with the text of the current subgoal: objectives and loss.

From the paper's appendix on alignment; used in training only. H (B, L, d_m) are memory tokens, the mask (B, L) marks
real tokens, T are text embeddings of width d_t. Vectors with a hat in the paper are L2-normalised here as well.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from lerobot_memobench.policies.memobench_mem.losses import joint, mean_over_ranks, world_size
from lerobot_memobench.policies.memobench_mem.memory.mechanism import TEXT, TEXT_MASK

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
    """An objective with a head ``project``, which maps memory vectors to the width of text embeddings."""

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
        """Return further numbers to log."""
        return {}


class SemanticAlignment(Alignment):
    """Cosine distance between the projected mean memory token and its text: mean of 1 - z.T over the batch."""

    def embed(self, memory: Tensor, memory_mask: Tensor) -> Tensor:
        """Return the normalised projection (B, d_t) of the masked mean over memory tokens."""
        return F.normalize(self.project(masked_mean(memory, memory_mask)), dim=-1)

    def pairs(  # type: ignore[override]  # the tensors of `usable`
        self, memory: Tensor, memory_mask: Tensor, text: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return pooled memories and their texts."""
        return self.embed(memory, memory_mask), F.normalize(text, dim=-1)

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Return the loss (scalar) of memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = self.pairs(memory, memory_mask, text)
        return (1.0 - (z * t).sum(dim=-1)).sum() / mean_over_ranks(z.new_tensor(len(z)))


class ContrastiveAlignment(SemanticAlignment):
    """Two-way retrieval within the joint batch of all ranks.

    Repeated subgoals are positives; rows of targets sum to one.
    """

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(INITIAL_TEMPERATURE)))

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Return the loss (scalar) of memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = map(joint, self.pairs(memory, memory_mask, text))
        logits = z @ t.T / self.log_temperature.exp()
        positive = same_text(t).to(logits.dtype)
        target = positive / positive.sum(dim=1, keepdim=True)
        # Both directions weigh the pair (memory i, text j) by the row-normalised target, the paper's Y_ij and Y_ji.
        memory_to_text = -(target * F.log_softmax(logits, dim=1)).sum() / len(z)
        text_to_memory = -(target * F.log_softmax(logits, dim=0)).sum() / len(z)
        return 0.5 * (memory_to_text + text_to_memory)

    def numbers(self) -> dict[str, float]:
        """Return the learned temperature."""
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

    def pairs(  # type: ignore[override]  # the tensors of `usable`
        self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return valid frames and their texts."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        return z[valid], F.normalize(text, dim=-1)[valid]

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> Tensor:
        """Return the loss (scalar) of memory (B, F*P, d_m), its mask (B, F*P), text (B, F, d_t) and its mask (B, F)."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        # The embedding of a frame without text may be anything, even NaN.
        text = F.normalize(torch.where(rearrange(valid, "b f -> b f 1"), text, torch.ones_like(text)), dim=-1)
        weights = self.weights(valid)
        return (weights * (1.0 - (z * text).sum(dim=-1))).sum() / mean_over_ranks(weights.sum()).clamp(
            min=0.5 / world_size()
        )


def retrieval_accuracy(memory: Tensor, text: Tensor) -> float:
    """Return the share of memory vectors (N, d_t) whose nearest text among (N, d_t) equals their own (top-1)."""
    if len(memory) == 0:
        return 0.0
    nearest_text = (memory @ text.T).argmax(dim=1)
    return float(same_text(text).gather(1, nearest_text[:, None]).float().mean())


def make_alignment(name: str, memory_dim: int, text_dim: int, tokens_per_frame: int) -> Alignment | None:
    """Build the objective ``name``; ``none`` gives None.

    Its `Alignment.usable` takes texts (B, d_t) and text_mask (B,) with semantic and contrastive, (B, F, d_t) and
    (B, F) with framewise.
    """
    if name == "none":
        return None
    if name == "framewise":
        return FramewiseAlignment(memory_dim, text_dim, tokens_per_frame)
    return {"semantic": SemanticAlignment, "contrastive": ContrastiveAlignment}[name](memory_dim, text_dim)


# -- loss of a training step ------------------------------------------------------------------------------------------


def alignment_loss(
    alignment: Alignment,
    weight: float,
    batch: Mapping[str, Tensor],
    memory: Tensor,
    mask: Tensor,
    encoder: Sequence[Tensor],
) -> tuple[Tensor, dict[str, float]]:
    """Compute the alignment loss of memory tokens (B, L, d_m), with ``mask`` (B, L), and the texts of a batch.

    The average of the losses of several ranks is the loss of their joint batch.

    Args:
        encoder: the memory's parameters; the norm of their gradient is logged.

    Returns:
        The weighted loss (scalar), and numbers to log; no numbers if no sample of any rank has a text.
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
        logged["align_grad_norm"] = mean_over_ranks(torch.cat([each.reshape(-1) for each in gradients])).norm().item()
    with torch.no_grad():
        logged["align_top1"] = retrieval_accuracy(*map(joint, alignment.pairs(*usable)))
    return weighted, logged | alignment.numbers()


def embedded_texts(embeddings: Tensor, rows: Tensor) -> dict[str, Tensor]:
    """Return the texts (..., d_t) of frames and their mask (...), as inputs of `alignment_loss`.

    Args:
        embeddings: of all texts, (T, d_t). rows: (...) integers, row of each frame's text, -1 for none.
    """
    return {TEXT_MASK: rows >= 0, TEXT: embeddings[rows.long().clamp(min=0)]}
