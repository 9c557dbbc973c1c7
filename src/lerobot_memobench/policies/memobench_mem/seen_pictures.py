"""What eyes see in a dataset, made once: all tokens of every picture, and pooled ones of what is remembered.

Both are feature caches (`datasets.feature_cache`), so they are found, finished, waited for and refused alike: one of each
camera's present pictures, at every frame, and the memory's. The memory's is pooled from its camera's, so no video is
decoded twice. Training samples are then made of the dataset's columns in main memory and of tokens that are read where
they lie (`recorded_items`).
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.building import (
    FrameEncoder,
    TextEncoder,
    build_feature_cache,
    require_room,
)
from lerobot_memobench.datasets.feature_cache.layout import find_cache
from lerobot_memobench.datasets.feature_cache.reading import FeatureCache, RecordedFrames, read_recorded
from lerobot_memobench.datasets.lerobot_format.layout import read_info
from lerobot_memobench.envs.prompting import name_in_data
from lerobot_memobench.io import in_words
from lerobot_memobench.perception.tower import GRID, POOLED, WIDTH
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.perception.eyes import EyePerception, seen_key

logger = logging.getLogger(__name__)


@dataclass
class Tokens:
    """What makes the tokens of a cache; a `FrameEncoder`."""

    key: str
    tokens_per_frame: int
    make: Callable[[Tensor], Tensor]
    dim: int = WIDTH

    def __call__(self, images: Tensor) -> Tensor:
        """Make them."""
        return self.make(images)


@dataclass(frozen=True)
class Wanted:
    """A cache that is wanted: of which camera, at every how many frames, made how, and where.

    Attributes:
        name: the camera's at the policy. camera: in the dataset.
    """

    name: str
    camera: str
    stride: int
    tokens: FrameEncoder
    folder: Path

    def open(self, root: Path) -> FeatureCache:
        """Open it, which is there."""
        how: dict[str, Any] = {"camera": self.camera, "stride": self.stride, "place": self.folder.parent}
        return FeatureCache.open(root, self.folder.name, frames_key=self.tokens.key, **how)


def make_caches(
    root: Path,
    config: MemobenchMemConfig,
    eyes: EyePerception,
    texts: TextEncoder,
    *,
    tell: Callable[[str], None] = logger.info,
    **how: Any,
) -> tuple[FeatureCache | None, dict[str, FeatureCache]]:
    """Make or finish what ``eyes`` see of the dataset at ``root``; how large it will be is told before.

    Args:
        how: of `build_feature_cache`.

    Returns:
        The memory's cache, None where nothing is remembered, and those of the present pictures by their cameras' names
        at the policy.

    Raises:
        MemobenchError: the dataset lacks a camera, or the disk has no room for all of them.
    """
    frames = int(read_info(root).get("total_frames", 0))
    wanted = _wanted(root, config, eyes, cameras_of(root))
    memory = wanted[-1] if config.memory != "none" else None
    present = wanted if memory is None else wanted[:-1]
    sizes = {cache.folder: _bytes(cache, frames) for cache in wanted}
    tell(
        f"What is seen in the {frames:,} frames of {root} takes {in_words(sum(sizes.values()))}: "
        f"{in_words(2 * GRID**2 * WIDTH)} of each of {len(present)} pictures of a frame, and "
        f"{in_words(2 * POOLED**2 * WIDTH)} of every frame that is remembered; what is not there yet is made now."
    )
    require_room(wanted[-1].folder.parent, sizes)
    busy = []
    for cache in present:
        try:
            _make(root, cache, texts, tell=tell, wait=come_back, **how)
        except Busy:
            busy.append(cache)  # whoever trains beside us is at it; the other camera's is made here meanwhile
    for cache in busy:
        _make(root, cache, texts, tell=tell, **how)
    opened = {cache.name: cache.open(root) for cache in present}
    if memory is None:
        return None, opened
    _make(root, memory, texts, read=opened[memory.name].tokens, tell=tell, **how)
    return memory.open(root), opened


def cameras_of(root: Path) -> list[str]:
    """Return the cameras of a dataset, in its order."""
    features = read_info(root)["features"].items()
    return [name for name, feature in features if feature.get("dtype") in ("video", "image")]


class Busy(Exception):
    """Another process is making this."""


def come_back(folder: Path) -> None:
    """Wait for no other process: a ``wait`` of `build_feature_cache`.

    Raises:
        Busy: in any case.
    """
    raise Busy(folder)


def _make(root: Path, cache: Wanted, texts: TextEncoder, **how: Any) -> None:
    named: dict[str, Any] = {"camera": cache.camera, "stride": cache.stride, "place": cache.folder.parent}
    build_feature_cache(root, cache.folder.name, cache.tokens, texts, **named, **how)


def _wanted(root: Path, config: MemobenchMemConfig, eyes: EyePerception, cameras: Sequence[str]) -> list[Wanted]:
    """Return the caches: of the present of each camera, and last the memory's, where something is remembered."""

    def wanted(name: str, stride: int, begins: str, tokens: Tokens) -> Wanted:
        camera = name_in_data(name)
        where: dict[str, Any] = {"camera": camera, "stride": stride, "place": config.cache_place}
        return Wanted(name, camera, stride, tokens, find_cache(root, begins, frames_key=tokens.key, **where))

    whole = Tokens(eyes.present_key, GRID**2, eyes.look)
    pooled = Tokens(eyes.key, eyes.tokens_per_frame, eyes.pooled)
    seen = dict.fromkeys(eyes.cameras or [*cameras, eyes.remembers])
    present = [wanted(camera, 1, f"{config.size}-present", whole) for camera in seen]
    if config.memory == "none":
        return present
    return [*present, wanted(eyes.remembers, config.memory_stride, config.cache_name, pooled)]


def _bytes(cache: Wanted, frames: int) -> int:
    """Return about how large a cache is; each episode may remember one frame more."""
    return -(-frames // cache.stride) * cache.tokens.tokens_per_frame * cache.tokens.dim * 2


def open_pictures(
    root: Path,
    config: MemobenchMemConfig,
    eyes: EyePerception,
    texts: TextEncoder,
    names: Sequence[str],
) -> RecordedFrames:
    """Open what training looks up of the dataset at ``root``: its columns ``names``, and what ``eyes`` see.

    Raises:
        MemobenchError: the dataset lacks a column, or a cache cannot be made.
    """
    memory, present = make_caches(
        root, config, eyes, texts, progress=lambda done, count: logger.info("seen: %d of %d episodes", done, count)
    )
    columns, table = read_recorded(root, names)
    columns |= {seen_key(camera): cache.all_tokens() for camera, cache in present.items()}

    def remember(_: Any, frames: Sequence[int]) -> Tensor:
        """Return what is remembered of frames of one episode, by their global numbers."""
        if memory is None:  # training asks for none; a sample's shape is asked for all the same
            return torch.zeros(len(frames), eyes.tokens_per_frame, WIDTH)
        episode, first = memory.locate(frames[0])
        return memory.tokens(episode, [(first + frame - frames[0]) // memory.meta.stride for frame in frames])

    return RecordedFrames(root, columns, table, texts, remember=remember, key=eyes.key, stride=config.memory_stride)
