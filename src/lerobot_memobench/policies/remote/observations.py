"""From LeRobot's batch of observations to what a policy server is sent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from lerobot.utils.constants import OBS_IMAGES, OBS_STATE, OBS_STR
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.remote.dialects import STATE, TASK

EXECUTION = 1


@dataclass(frozen=True)
class Row:
    """One environment's part of a batch; nothing is copied until it is asked for."""

    batch: Mapping[str, Any]
    number: int

    def scalar(self, name: str) -> int | None:
        """Return an observation that is one whole number, None where the environment does not tell it."""
        value = self.batch.get(f"{OBS_STR}.{name}")
        return None if value is None else round(float(value[self.number].reshape(-1)[0]))

    @property
    def blank(self) -> bool:
        """Whether this row is not simulated: an episode that the log holds already observes nothing but zeros."""
        found = [value[self.number] for key, value in self.batch.items() if key == OBS_STATE or OBS_IMAGES in key]
        return bool(found) and not any(bool(value.any()) for value in found)

    def get(self, name: str) -> Any:
        """Return an observation by our name: an image (H, W, 3) uint8, a vector float32, or the instruction."""
        if name == TASK:
            return str(self.batch[TASK][self.number])
        for key in (f"{OBS_IMAGES}.{name}", OBS_STATE if name == STATE else f"{OBS_STR}.{name}"):
            if key in self.batch:
                value = self.batch[key][self.number]
                return to_image(value) if OBS_IMAGES in key else value.float().cpu().numpy()
        known = [key.removeprefix(f"{OBS_IMAGES}.").removeprefix(f"{OBS_STR}.") for key in self.batch if OBS_STR in key]
        raise MemobenchError(
            f"policy.keys names {name!r}, which the environment does not observe; known are "
            f"{', '.join(sorted([*known, TASK]))}"
        )


def to_image(value: Tensor) -> NDArray[np.uint8]:
    """Return LeRobot's image (3, H, W) in [0, 1] as it was rendered, (H, W, 3) uint8."""
    pixels = (value.float() * 255).round().clamp(0, 255).to(torch.uint8)
    array: NDArray[np.uint8] = pixels.permute(1, 2, 0).contiguous().cpu().numpy()
    return array


def fit(image: NDArray[np.uint8], side: int | None, mirror: bool = False) -> NDArray[np.uint8]:
    """Return an image of (side, side, 3), scaled bilinearly and padded with black; as it is where side is None.

    Equal to openpi-client's ``resize_with_pad``, pixel for pixel.
    """
    if mirror:
        image = np.ascontiguousarray(image[:, ::-1])
    height, width = image.shape[:2]
    if side is None or (height, width) == (side, side):
        return image
    ratio = max(width, height) / side
    size = int(width / ratio), int(height / ratio)
    padded = Image.new("RGB", (side, side))
    padded.paste(
        Image.fromarray(image).resize(size, Image.Resampling.BILINEAR), ((side - size[0]) // 2, (side - size[1]) // 2)
    )
    return np.asarray(padded)
