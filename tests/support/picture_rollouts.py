"""What a rollout sees of the synthetic dataset's videos, beside what training reads; shared by tests of perception."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_STATE

from lerobot_memobench.datasets.frames import frame_reader
from lerobot_memobench.perception.detector import Detector
from lerobot_memobench.perception.visual_encoder import VisualEncoder
from lerobot_memobench.perception.weights import save_detector
from research.detector.labels import kinds
from tests.support.synthetic_dataset import CAMERAS, LENGTHS

STARTS = np.cumsum([0, *LENGTHS])
"""First frames of the episodes."""


def made_detector(path: Path, seed: int) -> Path:
    """Write a detector that detects something everywhere."""
    torch.manual_seed(seed)
    detector = Detector(VisualEncoder().eval(), kinds())
    torch.nn.init.zeros_(detector.fine_heads.heatmap.bias)
    save_detector(detector, path)
    return path


reader_of = functools.cache(frame_reader)


def pictures_of(root: Path, index: int) -> dict[str, torch.Tensor]:
    """Return both cameras' pictures of a frame, (1, 3, H, W), as the videos show it."""
    episode = int(np.searchsorted(STARTS, index, "right")) - 1
    return {camera: reader_of(root, camera)(episode, [int(index - STARTS[episode])]) for camera in CAMERAS}


def observed(root: Path, dataset: Any, index: int) -> dict[str, Any]:
    """Return a rollout's observation at a frame."""
    step = float(index - STARTS[int(np.searchsorted(STARTS, index, "right")) - 1])
    clock = {"observation.step": torch.tensor([step]), "observation.phase": torch.ones(1)}
    state = {OBS_STATE: dataset.hf_dataset[index][OBS_STATE][None]}
    return {**pictures_of(root, index), **state, **clock, "task": [dataset[index]["task"]]}
