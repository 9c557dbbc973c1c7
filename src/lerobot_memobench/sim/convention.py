"""Conventions of pictures: their names and orientation in observations and datasets.

``upright``: as a person sees the scene. ``libero``: mirrored left to right, as in LIBERO's data: robosuite reads rows
bottom-up, and LIBERO's tools turn the pictures by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

UPRIGHT, MIRRORED = "upright", "libero"
WRIST = {UPRIGHT: "wrist_image", MIRRORED: "image2"}
CONVENTIONS = {convention: {"image": "image", "wrist_image": wrist} for convention, wrist in WRIST.items()}
"""Convention -> camera -> name of its picture."""
STATED = "trained_convention"
"""Key by which a policy server states the convention of its policy's training."""


def shown(pictures: Mapping[str, NDArray[np.uint8]], convention: str) -> dict[str, NDArray[np.uint8]]:
    """Return each camera's upright picture (H, W, 3) by the name and in the orientation of a convention, as a copy."""
    step = -1 if convention == MIRRORED else 1
    return {name: pictures[camera][:, ::step].copy() for camera, name in CONVENTIONS[convention].items()}


def convention_of(features: Mapping[str, Any]) -> str | None:
    """Return the convention of a dataset's pictures by the description of its columns; None if it is unknown."""
    pictures = {name: one for name, one in features.items() if one.get("dtype") in ("video", "image")}
    if "observation.images.image2" in pictures or any(one.get("convention") == MIRRORED for one in pictures.values()):
        return MIRRORED
    return UPRIGHT if pictures and "checkpoint.index" in features else None  # a column of this package
