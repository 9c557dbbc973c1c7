"""What rows of a rollout and samples of a training remember with ``memory=frames``, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS, Histories


def histories(frames: Tensor, steps: Tensor, mask: Tensor) -> Histories:
    """Return histories of frames (B, F, P, D) at steps (B, F), of which mask (B, F) are real; none are shared."""
    places = torch.arange(mask.numel(), device=mask.device).reshape(mask.shape)
    return Histories(frames.flatten(0, 1), steps.flatten(), places.masked_fill(~mask, -1))


def trained_on(batch: Mapping[str, Tensor]) -> list[tuple[Tensor, list[int]]]:
    """Return of each training sample the frames (n, P, D) that it remembers, and their control steps."""
    places = [row[row >= 0] for row in batch[PLACES]]
    return [(batch[FRAMES][row], batch[STEPS][row].tolist()) for row in places]


def remembered(policy: Any, rows: Sequence[int]) -> list[tuple[Tensor, list[int]]]:
    """Return the same of rows of a policy's rollout."""
    found = []
    for row in rows:
        (kept,) = policy.rollout.rows[row].memory
        read = [kept[slot] for slot in sample_frames(len(kept) - 1, policy.config.memory_frames)]
        found.append((torch.stack([frame.stored for frame in read]), [frame.step for frame in read]))
    return found
