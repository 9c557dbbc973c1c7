"""What eyes find in a dataset's pictures, made once for every frame: a feature cache of slots instead of tokens.

A cache holds bfloat16 numbers, which know places to 4 mm. So a slot's number is kept as two: what it is rounded to, and
what that leaves of it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import OBS_STATE
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.building import TextEncoder, build_feature_cache
from lerobot_memobench.datasets.feature_cache.frames import FrameReader, frame_reader
from lerobot_memobench.datasets.feature_cache.layout import find_cache
from lerobot_memobench.datasets.feature_cache.reading import FeatureCache, read_recorded
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.perception.found import VIEWS, ObjectsInPictures
from lerobot_memobench.sim.object_layout import SIZE

logger = logging.getLogger(__name__)

Look = tuple[dict[str, Tensor], Tensor]
"""Pictures of some frames by their names, and the robot's states."""


@dataclass
class SlotEncoder:
    """What makes a cache's numbers; a `FrameEncoder`."""

    look: ObjectsInPictures
    tokens_per_frame: int = 2
    dim: int = SIZE

    @property
    def key(self) -> str:
        """Identity of what is found."""
        return self.look.key

    def __call__(self, seen: Look) -> Tensor:
        """Return the slots of frames in two parts, (N, 2, SIZE) bfloat16."""
        slots = self.look(*seen)
        rounded = slots.to(torch.bfloat16)
        return torch.stack([rounded, (slots - rounded.float()).to(torch.bfloat16)], dim=1)


def make_found(
    root: Path, config: MemobenchMemConfig, look: ObjectsInPictures, texts: TextEncoder, **how: Any
) -> FeatureCache:
    """Make or finish the cache of what is found in the pictures of the dataset at ``root``.

    Args:
        how: of `build_feature_cache`.

    Raises:
        MemobenchError: the dataset lacks a camera, or the disk has no room.
    """
    where: dict[str, Any] = {"camera": next(iter(VIEWS)), "stride": 1}
    folder = find_cache(root, "objects", frames_key=look.key, place=config.cache_place, **where)
    where["place"] = folder.parent
    build_feature_cache(root, folder.name, SlotEncoder(look), texts, read=_reader(root), **where, **how)
    return FeatureCache.open(root, folder.name, frames_key=look.key, **where)


def _reader(root: Path) -> FrameReader:
    """Return what reads frames of all cameras, and the states at them."""
    readers = {name: frame_reader(root, name) for name in VIEWS}
    recorded = cache(lambda: read_recorded(root, [OBS_STATE]))  # read when a frame is: a whole cache needs none

    def read(episode: int, numbers: list[int]) -> Look:
        columns, table = recorded()
        states = columns[OBS_STATE][[int(table.episodes[episode]) + number for number in numbers]]
        return {name: one(episode, numbers) for name, one in readers.items()}, states

    return read


def found_in(root: Path, config: MemobenchMemConfig, look: ObjectsInPictures, texts: TextEncoder, **how: Any) -> Tensor:
    """Return what is found at every frame of the dataset at ``root``, (N, SIZE) float32; all else as `make_found`."""

    def tell(done: int, count: int) -> None:
        logger.info("objects found in %d of %d episodes", done, count)

    return make_found(root, config, look, texts, progress=tell, **how).all_tokens().sum(dim=1, dtype=torch.float32)
