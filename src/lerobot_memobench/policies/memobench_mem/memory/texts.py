"""Texts of checkpoints as tokens, for memories that say one of them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class CheckpointTexts(nn.Module):
    """Texts as learned tokens of their words, and behind the last text an empty one, for where there is none to say.

    Texts share the words that they have in common. Each ends with one token that all have.
    """

    rows: Tensor

    def __init__(self, texts: Sequence[str], width: int) -> None:
        super().__init__()
        spelled = [text.lower().split() for text in (*texts, "")]
        number = {word: row for row, word in enumerate(sorted({word for words in spelled for word in words}), start=1)}
        self.length = 1 + max(map(len, spelled))
        padding = [[-1] * (self.length - 1 - len(words)) for words in spelled]
        rows = [[*(number[word] for word in words), 0, *rest] for words, rest in zip(spelled, padding, strict=True)]
        # Known without weights: a model that is built on the meta device has it too.
        self.register_buffer("rows", torch.tensor(rows, device="cpu"), persistent=False)
        self.embedding = nn.Embedding(1 + len(number), width)

    def forward(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Return tokens (B, n, d) of texts by their numbers (B,), -1 being the empty one, and which are real (B, n)."""
        rows = self.rows[numbers]
        return self.embedding(rows.clamp(min=0)), rows >= 0


def scored(scores: Tensor, choices: Tensor) -> Tensor:
    """Return scores (B, S + 1) of the texts that may be said, given those (B, S) of all.

    Those that ``choices`` (B, S) leaves out come behind the empty one, the last, which itself is said only where no
    other may be.
    """
    low = torch.finfo(torch.float32).min
    masked = scores.to(torch.float32).masked_fill(~choices, low)
    return torch.cat([masked, masked.new_full((len(masked), 1), low / 2)], dim=1)
