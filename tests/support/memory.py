"""Frames that rows of a rollout and samples of a training remember with ``memory=frames``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.policies.memobench_mem.memory.frames import sample_frames
from lerobot_memobench.policies.memobench_mem.memory.mechanism import FRAMES, PLACES, STEPS, Histories


def histories(frames: Tensor, steps: Tensor, mask: Tensor) -> Histories:
    """Return histories of frames (B, F, P, D) at steps (B, F) with a mask (B, F), without shared frames."""
    places = torch.arange(mask.numel(), device=mask.device).reshape(mask.shape)
    return Histories(frames.flatten(0, 1), steps.flatten(), places.masked_fill(~mask, -1))


def trained_on(batch: Mapping[str, Tensor]) -> list[tuple[Tensor, list[int]]]:
    """Return the remembered frames (n, P, D) of each training sample, and their control steps."""
    places = [row[row >= 0] for row in batch[PLACES]]
    return [(batch[FRAMES][row], batch[STEPS][row].tolist()) for row in places]


def remembered(policy: Any, rows: Sequence[int]) -> list[tuple[Tensor, list[int]]]:
    """Return the remembered frames of rows of a policy's rollout, and their control steps."""
    found = []
    for row in rows:
        (kept,) = policy.rollout.envs[row].memory
        read = [kept[slot] for slot in sample_frames(len(kept) - 1, policy.model.memory.settings.frames)]
        found.append((torch.stack([frame.stored for frame in read]), [frame.step for frame in read]))
    return found
