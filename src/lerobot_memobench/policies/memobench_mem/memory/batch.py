"""How memory lies in a batch: right-padded rows of frames, and the names by which training samples carry them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.mechanism import Frame

TOKENS, STEPS, MASK = "memory.tokens", "memory.steps", "memory.mask"
FRAMES = "memory.frames"
"""Numbers (B, F) of remembered frames in the dataset, by which samples of one episode share what they remember; -1
where a row has none."""
TEXT, TEXT_MASK = "memory.text", "memory.text_mask"
PHASE = "phase"


class MemoryBatch(NamedTuple):
    """Frames read for B samples: tokens (B, F, P, D), control steps (B, F) int64, mask (B, F) bool."""

    tokens: Tensor
    steps: Tensor
    mask: Tensor

    def to(self, device: torch.device) -> MemoryBatch:
        """Move it to a device."""
        return MemoryBatch(*(tensor.to(device) for tensor in self))


def collate_frames(rows: Sequence[Sequence[Frame]], frames: int) -> MemoryBatch:
    """Right-pad what was read for each sample to ``frames`` frames."""
    like = rows[0][0].tokens
    batch = MemoryBatch(
        tokens=torch.zeros(len(rows), frames, *like.shape, dtype=like.dtype),
        steps=torch.zeros(len(rows), frames, dtype=torch.int64),
        mask=torch.zeros(len(rows), frames, dtype=torch.bool),
    )
    for number, row in enumerate(rows):
        batch.tokens[number, : len(row)] = torch.stack([frame.tokens for frame in row])
        batch.steps[number, : len(row)] = torch.tensor([frame.step for frame in row])
        batch.mask[number, : len(row)] = True
    return batch
