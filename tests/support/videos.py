"""Videos as datasets have them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.video import VideoWriter


def encode_video(frames: NDArray[np.uint8], path: Path) -> None:
    """Encode (T, H, W, 3) uint8 frames to ``path``."""
    writer = VideoWriter(path)
    for frame in frames:
        writer.add(frame)
    writer.close()
