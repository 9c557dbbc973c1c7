"""Objectives that tie memory tokens to the text of the checkpoint being worked on (paper, appendix on alignment).

All are used in training only. H (B, L, d_m) are memory tokens, the mask (B, L) marks the real ones, T are text
embeddings of width d_t. Vectors with a hat in the paper are L2-normalised; so are they here.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod

import torch
import torch.nn.functional as F
from einops import rearrange
from torch import Tensor, nn

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.policies.memobench_mem.ranks import joint, mean_over_ranks, world_size

POSITIVE_SIMILARITY = 0.99  # texts more similar than this are the same subgoal
INITIAL_TEMPERATURE = 0.07


def masked_mean(values: Tensor, mask: Tensor) -> Tensor:
    """Mean of ``values`` (..., N, D) over N where ``mask`` (..., N); zero where nothing is marked."""
    weights = rearrange(mask.to(values.dtype), "... n -> ... n 1")
    return (values * weights).sum(dim=-2) / weights.sum(dim=-2).clamp(min=1.0)


def same_text(text: Tensor) -> Tensor:
    """(N, N) bool: which of the normalised text embeddings (N, d_t) say the same."""
    return text @ text.T > POSITIVE_SIMILARITY


class Alignment(nn.Module, ABC):
    """An objective with a head, ``project``: memory vectors to the width of text embeddings."""

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__()
        self.project = nn.Linear(memory_dim, text_dim)

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """Return the arguments of `forward` and `pairs` for a batch; ``text_mask`` marks what has a text.

        Samples of an episode without any text have nothing to align to, and are left out.
        """
        return memory[text_mask], memory_mask[text_mask], text[text_mask]

    @abstractmethod
    def pairs(self, *usable: Tensor) -> tuple[Tensor, Tensor]:
        """Memory vectors and the texts they belong to, both (N, d_t) and normalised."""

    @abstractmethod
    def answer(self, memory: Tensor, memory_mask: Tensor, newest: Tensor) -> Tensor:
        """What the head says (B, d_t) of the present, whose frame's tokens ``newest`` (B, L) marks."""

    def numbers(self) -> dict[str, float]:
        """What else is worth a line in the log."""
        return {}


class SemanticAlignment(Alignment):
    """Cosine distance between the pooled memory, projected, and its text: mean of 1 - z.T over the batch."""

    def embed(self, memory: Tensor, memory_mask: Tensor) -> Tensor:
        """Normalised projection (B, d_t) of the masked mean over memory tokens."""
        return F.normalize(self.project(masked_mean(memory, memory_mask)), dim=-1)

    def pairs(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> tuple[Tensor, Tensor]:
        """Pooled memories and their texts."""
        return self.embed(memory, memory_mask), F.normalize(text, dim=-1)

    def answer(self, memory: Tensor, memory_mask: Tensor, newest: Tensor) -> Tensor:
        """What all of the memory says."""
        return self.embed(memory, memory_mask)

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = self.pairs(memory, memory_mask, text)
        return (1.0 - (z * t).sum(dim=-1)).sum() / mean_over_ranks(z.new_tensor(len(z)))


class ContrastiveAlignment(SemanticAlignment):
    """Two-way retrieval within the batch, that of all ranks together.

    Repeated subgoals are positives; rows of targets sum to one.
    """

    def __init__(self, memory_dim: int, text_dim: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.log_temperature = nn.Parameter(torch.tensor(math.log(INITIAL_TEMPERATURE)))

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, L, d_m), memory_mask (B, L), text (B, d_t)."""
        z, t = map(joint, self.pairs(memory, memory_mask, text))
        logits = z @ t.T / self.log_temperature.exp()
        positive = same_text(t).to(logits.dtype)
        target = positive / positive.sum(dim=1, keepdim=True)
        # Both directions weigh pair (memory i, text j) by the row-normalised target, as the paper's Y_ij and Y_ji.
        memory_to_text = -(target * F.log_softmax(logits, dim=1)).sum() / len(z)
        text_to_memory = -(target * F.log_softmax(logits, dim=0)).sum() / len(z)
        return 0.5 * (memory_to_text + text_to_memory)

    def numbers(self) -> dict[str, float]:
        """The learned temperature."""
        return {"align_temperature": self.log_temperature.exp().item()}


class FramewiseAlignment(Alignment):
    """Cosine distance per remembered frame to that frame's own text, recent frames weighing up to twice as much."""

    def __init__(self, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> None:
        super().__init__(memory_dim, text_dim)
        self.frames, self.tokens_per_frame = frames, tokens_per_frame

    def usable(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, ...]:
        """All of it: each frame has a text of its own, or is left out by itself."""
        return memory, memory_mask, text, text_mask

    def _frames(self, memory: Tensor, memory_mask: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Frame vectors (B, F, d_t), normalised, and which frames count (B, F): real ones that have a text."""
        tokens = rearrange(memory, "b (f p) d -> b f p d", f=self.frames, p=self.tokens_per_frame)
        token_mask = rearrange(memory_mask, "b (f p) -> b f p", f=self.frames, p=self.tokens_per_frame)
        z = F.normalize(self.project(masked_mean(tokens, token_mask)), dim=-1)
        return z, token_mask.bool().any(dim=-1) & text_mask.bool()

    @staticmethod
    def weights(valid: Tensor) -> Tensor:
        """Recency weights (B, F) from ``valid`` (B, F): 0.5 + 0.5 rank / max(N - 1, 1), zero where not valid."""
        count = valid.sum(dim=1, keepdim=True)
        rank = valid.cumsum(dim=1) - 1
        return (0.5 + 0.5 * rank / (count - 1).clamp(min=1)) * valid

    def pairs(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> tuple[Tensor, Tensor]:
        """Valid frames and their texts."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        return z[valid], F.normalize(text, dim=-1)[valid]

    def answer(self, memory: Tensor, memory_mask: Tensor, newest: Tensor) -> Tensor:
        """What the newest frame says."""
        return self.project(masked_mean(memory, newest))

    def forward(self, memory: Tensor, memory_mask: Tensor, text: Tensor, text_mask: Tensor) -> Tensor:
        """Loss (scalar) from memory (B, F*P, d_m), memory_mask (B, F*P), text (B, F, d_t), text_mask (B, F)."""
        z, valid = self._frames(memory, memory_mask, text_mask)
        # A frame without text may hold any numbers, not-a-number too, so they are replaced before they are used.
        text = F.normalize(torch.where(rearrange(valid, "b f -> b f 1"), text, torch.ones_like(text)), dim=-1)
        weights = self.weights(valid)
        return (weights * (1.0 - (z * text).sum(dim=-1))).sum() / mean_over_ranks(weights.sum()).clamp(
            min=0.5 / world_size()
        )


def retrieval_accuracy(memory: Tensor, text: Tensor) -> float:
    """Share of memory vectors (N, d_t) whose nearest text among (N, d_t) says the same as their own (top-1)."""
    if len(memory) == 0:
        return 0.0
    nearest_text = (memory @ text.T).argmax(dim=1)
    return float(same_text(text).gather(1, nearest_text[:, None]).float().mean())


def make_alignment(name: str, memory_dim: int, text_dim: int, frames: int, tokens_per_frame: int) -> Alignment | None:
    """Build the objective ``name``; ``none`` gives None.

    Its `Alignment.usable` takes texts (B, d_t) and text_mask (B,) with semantic and contrastive, (B, F, d_t) and
    (B, F) with framewise.

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
