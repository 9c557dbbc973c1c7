"""Objectives that tie memory tokens to the text of the checkpoint being worked on (paper, appendix on alignment).

All are used in training only. H (B, L, d_m) are memory tokens, the mask (B, L) marks the real ones, T are text
embeddings of width d_t. Vectors with a hat in the paper are L2-normalised; so are they here.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError, nearest

POSITIVE_SIMILARITY = 0.99  # texts more similar than this are the same subgoal
INITIAL_TEMPERATURE = 0.07


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` (..., N, D) over N where ``mask`` (..., N); zero where nothing is marked."""
    weights = mask.to(values.dtype).unsqueeze(-1)
    return (values * weights).sum(dim=-2) / weights.sum(dim=-2).clamp(min=1.0)


def same_text(text: Tensor) -> Tensor:
    """(N, N) bool: which of the normalised text embeddings (N, d_t) say the same."""
    return text @ text.T > POSITIVE_SIMILARITY


class SemanticAlignment(nn.Module):
    """Cosine distance between the pooled memory, projected, and its text: mean of 1 - z.T over the batch."""

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__()
        self.project = nn.Linear(memory_dim, text_dim)

    def embed(self, memory: Tensor, memory_mask: Tensor) -> Tensor:
        """Normalised projection (B, d_t) of the masked mean over memory tokens."""
        return F.normalize(self.project(masked_mean(memory, memory_mask)), dim=-1)

    def pairs(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Memory vectors and the texts they belong to, both (N, d_t) and normalised."""
        return self.embed(memory, memory_mask), F.normalize(text, dim=-1)

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = self.pairs(memory, memory_mask, text)
        return (1.0 - (z * t).sum(dim=-1)).mean()


class ContrastiveAlignment(SemanticAlignment):
    """Two-way retrieval within the batch; repeated subgoals are positives, rows of targets sum to one."""

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(INITIAL_TEMPERATURE)))

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = self.pairs(memory, memory_mask, text)
        logits = z @ t.T / self.log_temperature.exp()
        positive = same_text(t).to(logits.dtype)
        target = positive / positive.sum(dim=1, keepdim=True)
        # Both directions weigh pair (memory i, text j) by the row-normalised target, as the paper's Y_ij and Y_ji.
        memory_to_text = -(target * F.log_softmax(logits, dim=1)).sum() / len(z)
        text_to_memory = -(target * F.log_softmax(logits, dim=0)).sum() / len(z)
        return 0.5 * (memory_to_text + text_to_memory)


class FramewiseAlignment(nn.Module):
    """Cosine distance per remembered frame to that frame's own text, recent frames weighing up to twice as much."""

    def __init__(self, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> None:
        super().__init__()
        self.project = nn.Linear(memory_dim, text_dim)
        self.frames = frames
        self.tokens_per_frame = tokens_per_frame

    def _frames(self, memory: Tensor, memory_mask: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Frame vectors (B, F, d_t), normalised, and which frames count (B, F): real ones that have a text."""
        batch = memory.shape[0]
        tokens = memory.reshape(batch, self.frames, self.tokens_per_frame, -1)
        token_mask = memory_mask.reshape(batch, self.frames, self.tokens_per_frame)
        z = F.normalize(self.project(masked_mean(tokens, token_mask)), dim=-1)
        return z, token_mask.bool().any(dim=-1) & text_mask.bool()

    @staticmethod
    def weights(valid: Tensor) -> Tensor:
        """Recency weights (B, F) from ``valid`` (B, F): 0.5 + 0.5 rank / max(N - 1, 1), zero where not valid."""
        count = valid.sum(dim=1, keepdim=True)
        rank = valid.cumsum(dim=1) - 1
        return (0.5 + 0.5 * rank / (count - 1).clamp(min=1)) * valid

    def pairs(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Valid frame vectors and their texts, both (N, d_t) and normalised."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        return z[valid], F.normalize(text, dim=-1)[valid]

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, F*P, d_m), memory_mask (B, F*P), text (B, F, d_t), text_mask (B, F)."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        # A frame without text may hold any numbers, not-a-number too, so they are replaced before they are used.
        text = F.normalize(torch.where(valid[..., None], text, torch.ones_like(text)), dim=-1)
        weights = self.weights(valid)
        return (weights * (1.0 - (z * text).sum(dim=-1))).sum() / weights.sum().clamp(min=0.5)


def retrieval_accuracy(memory: Tensor, text: Tensor) -> float:
    """Share of memory vectors (N, d_t) whose nearest text among (N, d_t) says the same as their own (top-1)."""
    if len(memory) == 0:
        return 0.0
    nearest_text = (memory @ text.T).argmax(dim=1)
    return float(same_text(text).gather(1, nearest_text[:, None]).float().mean())


def make_alignment(name: str, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> nn.Module | None:
    """Build the objective ``name``; ``none`` gives None.

    Call semantic and contrastive as ``module(memory, memory_mask, text)`` with text (B, d_t), framewise as
    ``module(memory, memory_mask, text, text_mask)`` with text (B, F, d_t) and text_mask (B, F).

    Raises:
        MemobenchError: unknown name.
    """
    if name == "none":
        return None
    if name == "semantic":
        return SemanticAlignment(memory_dim, text_dim)
    if name == "contrastive":
        return ContrastiveAlignment(memory_dim, text_dim)
    if name == "framewise":
        return FramewiseAlignment(memory_dim, text_dim, frames, tokens_per_frame)
    known = ("none", "semantic", "contrastive", "framewise")
    raise MemobenchError(f"There is no alignment '{name}': {nearest(name, known)}")
