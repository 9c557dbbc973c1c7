"""Conventions of pictures: their names and orientation in observations and datasets.

``upright``: as a person sees the scene. ``libero``: mirrored left to right, as in LIBERO's data: robosuite reads rows
bottom-up, and LIBERO's tools turn the pictures by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.protocol import CAMERAS

UPRIGHT, MIRRORED = "upright", "libero"
CONVENTIONS = {UPRIGHT: {name: name for name in CAMERAS}, MIRRORED: {"image": "image", "wrist_image": "image2"}}
"""Convention -> camera -> name of its picture."""


def turned(pictures: NDArray[np.uint8], convention: str) -> NDArray[np.uint8]:
    """Return upright pictures (…, H, W, 3) in a convention's orientation, or such pictures upright, as a new array."""
    return pictures[..., :: -1 if convention == MIRRORED else 1, :].copy()


def shown(pictures: Mapping[str, NDArray[np.uint8]], convention: str) -> dict[str, NDArray[np.uint8]]:
    """Return each camera's upright picture by the name and in the orientation of a convention, as new arrays."""
    return {name: turned(pictures[camera], convention) for camera, name in CONVENTIONS[convention].items()}


def convention_of(features: Mapping[str, Any]) -> str | None:
    """Return the convention of a dataset's pictures by LeRobot's description of its columns; None if it is unknown.

    Datasets of this package without a convention have upright pictures.
    """
    pictures = {name: one for name, one in features.items() if one.get("dtype") in ("video", "image")}
    if "observation.images.image2" in pictures or any(one.get("convention") == MIRRORED for one in pictures.values()):
        return MIRRORED
    return UPRIGHT if pictures and "checkpoint.index" in features else None
