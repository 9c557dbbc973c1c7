"""Conventions of images: their names and orientation in observations and datasets.

``upright``: as a person sees the scene. ``libero``: mirrored left to right, as in LIBERO's data: robosuite reads rows
bottom-up, and LIBERO's tools turn the images by 180 degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

UPRIGHT, MIRRORED = "upright", "libero"
WRIST = {UPRIGHT: "wrist_image", MIRRORED: "image2"}
CONVENTIONS = {convention: {"image": "image", "wrist_image": wrist} for convention, wrist in WRIST.items()}
"""Convention -> camera -> name of its image."""
STATED = "trained_convention"  # key by which a policy server states the convention of its policy's training
OTHER = {UPRIGHT: MIRRORED, MIRRORED: UPRIGHT}
LIBERO_CAMERAS = {"image": "agentview_image", "wrist_image": "robot0_eye_in_hand_image"}
"""Camera -> its name in LIBERO, which LeRobot's ``camera_name_mapping`` maps to the name of its image."""


def image_names(convention: str, mapping: Mapping[str, str] | None = None) -> dict[str, str]:
    """Return camera -> name of its image, by a convention and LeRobot's ``camera_name_mapping``."""
    mapping = mapping or {}
    return {camera: mapping.get(LIBERO_CAMERAS[camera], name) for camera, name in CONVENTIONS[convention].items()}


def in_convention(
    images: Mapping[str, NDArray[np.uint8]], convention: str, mapping: Mapping[str, str] | None = None
) -> dict[str, NDArray[np.uint8]]:
    """Return each camera's upright image (H, W, 3) by the name and in the orientation of a convention, as a copy."""
    step = -1 if convention == MIRRORED else 1
    return {name: images[camera][:, ::step].copy() for camera, name in image_names(convention, mapping).items()}


def convention_of(features: Mapping[str, Any]) -> str | None:
    """Return the convention of a dataset's images by the description of its columns; None if it is unknown."""
    images = {name: feature for name, feature in features.items() if feature.get("dtype") in ("video", "image")}
    stated = {feature.get("convention") for feature in images.values()}
    if "observation.images.image2" in images or MIRRORED in stated:
        return MIRRORED
    ours = images and "checkpoint.index" in features  # a column of this package
    return UPRIGHT if ours or UPRIGHT in stated else None
