"""Films as one picture: a row for each, frames at even distances."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from PIL.Image import Image

FRAMES_PER_VIDEO = 6
COLUMN_WIDTH = 320
"""Width of a frame in the contact sheet, pixels."""

Frame = NDArray[np.uint8]
"""(height, width, 3), RGB."""


def contact_sheet(videos: Sequence[Path]) -> Image:
    """Return a picture with one row per video: frames at even distances, the last one included."""
    from PIL import Image

    rows = [
        np.concatenate([_resized(frame) for frame in evenly(read_video(video), FRAMES_PER_VIDEO)], axis=1)
        for video in videos
    ]
    return Image.fromarray(np.concatenate(rows, axis=0))


def evenly(frames: Sequence[Frame], count: int) -> list[Frame]:
    """Return ``count`` frames at even distances, the first and the last included."""
    return [frames[k] for k in np.linspace(0, len(frames) - 1, count).round().astype(int)]


def read_video(path: Path) -> list[Frame]:
    """Return every frame of a video."""
    import av

    with av.open(str(path)) as container:
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def _resized(frame: Frame) -> Frame:
    from PIL import Image

    height = round(frame.shape[0] * COLUMN_WIDTH / frame.shape[1])
    return np.asarray(Image.fromarray(frame).resize((COLUMN_WIDTH, height), Image.Resampling.LANCZOS))
