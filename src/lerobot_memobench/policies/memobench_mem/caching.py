"""The feature cache of a dataset, made and opened with the frozen towers of a policy."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE

from lerobot_memobench.datasets.feature_cache.building import Progress, build_feature_cache
from lerobot_memobench.datasets.feature_cache.frames import read_frame_table
from lerobot_memobench.datasets.feature_cache.layout import find_cache
from lerobot_memobench.datasets.feature_cache.reading import (
    FeatureCache,
    FrameLookup,
    RecordedFrames,
    RecordedTexts,
    read_recorded,
)
from lerobot_memobench.envs.prompting import name_in_data
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.perception.tower import Tower
from lerobot_memobench.perception.weights import load_eyes, load_tower
from lerobot_memobench.policies.memobench_mem.backbone import SizedPaliGemmaWithExpert
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.found_in_pictures import found_in, make_found
from lerobot_memobench.policies.memobench_mem.language.text_encoders import (
    SiglipTextEncoder,
    WordTextEncoder,
    make_text_encoder,
)
from lerobot_memobench.policies.memobench_mem.perception.eyes import EyePerception
from lerobot_memobench.policies.memobench_mem.perception.found import FOUND, FoundObjects, ObjectsInPictures
from lerobot_memobench.policies.memobench_mem.perception.frozen import VISION_SEED, seed_parameters
from lerobot_memobench.policies.memobench_mem.perception.objects import OBS_PHASE, OBS_RAW_STATE
from lerobot_memobench.policies.memobench_mem.perception.perception import Perception
from lerobot_memobench.policies.memobench_mem.perception.pixels import PixelPerception
from lerobot_memobench.policies.memobench_mem.seen_pictures import cameras_of, make_caches, open_pictures
from lerobot_memobench.policies.memobench_mem.weights import load_exactly, read_weights

logger = logging.getLogger(__name__)

RECORDED = (OBS_STATE, OBS_ENV_STATE, ACTION, "timestamp", "frame_index", "episode_index", "task_index", "index")
"""Columns that a policy which sees objects learns from."""

_VISION_PREFIX = "paligemma_with_expert.paligemma.model."


def load_sight(config: MemobenchMemConfig, weights: str | Path | None = None) -> EyePerception:
    """Load the tower of ``config``'s eyes alone; arguments and errors as of `load_perception`."""
    source = weights or config.base_weights
    if source is None:
        assert config.eyes is not None  # asked of a configuration that has some
        tower = load_tower(config.eyes)
    else:
        tower = Tower(folded=True).eval()
        load_exactly(tower, read_weights(source, _VISION_PREFIX + "vision_tower."), source, optional=set())
    width = config.dimensions.vlm.width
    return EyePerception(tower.to(config.device), [*config.image_features], config.memory_camera or "", width)


def load_perception(config: MemobenchMemConfig, weights: str | Path | None = None) -> PixelPerception:
    """Load the frozen image tower of ``config``'s size alone, without the rest of the model.

    Args:
        weights: folder or repository of a pi0.5 or memobench_mem checkpoint; None takes ``config.base_weights``, or
            the fixed-seed tower when there are none.

    Raises:
        MemobenchError: the weights cannot be read or do not fit, or there is no tower.
    """
    if config.sees_objects:
        raise MemobenchError(
            "perception=objects needs no feature cache where the environment tells the objects: training reads the "
            "dataset's columns; leave this command out, or name eyes that find them."
        )
    with torch.device("meta"):
        model = SizedPaliGemmaWithExpert(config).paligemma.model
    towers = type(model.vision_tower)(model.config.vision_config), type(model.multi_modal_projector)(model.config)
    tower, projector = (part.to(torch.float32).eval().requires_grad_(False) for part in towers)
    for part, name in ((tower, "vision_tower."), (projector, "multi_modal_projector.")):
        source = weights or config.base_weights
        if source is None:
            seed_parameters(part, VISION_SEED)
        else:
            load_exactly(part, read_weights(source, _VISION_PREFIX + name), source, optional=set())
        part.to(config.device)
    return PixelPerception(tower, projector, config.image_size, config.memory_camera or "")


def cache_dataset(
    root: Path,
    config: MemobenchMemConfig,
    *,
    weights: str | Path | None = None,
    batch_size: int = 64,
    workers: int | None = None,
    progress: Progress | None = None,
    tell: Callable[[str], None] = logger.info,
) -> Path:
    """Make (or finish) the cache that ``config`` reads of the dataset at ``root``.

    Args:
        config: a policy configuration, for example ``MemobenchMemConfig(size="tiny", memory_stride=1)``.
        weights: checkpoint whose image tower is used, see :func:`load_perception`.
        workers: threads that decode videos ahead of the tower; by the cores of the machine when None.
        progress: called with (episodes done, episodes in all).
        tell: told where it lies and how large it will be, before it is made.

    Returns:
        The cache's folder, ``<root>/feature_cache/<size>-stride<n>-<hash>``, or below ``config.memory_cache_dir``; with
        eyes that of the memory's, beside which those of the present lie.
    """
    config.memory_camera = config.memory_camera or next(iter(cameras_of(root)), None)
    how: dict[str, Any] = {"batch_size": batch_size, "workers": workers, "progress": progress, "tell": tell}
    if config.finds_objects:
        assert config.eyes is not None
        return make_found(root, config, ObjectsInPictures(load_eyes(config.eyes)), _text_encoder(config), **how).folder
    if config.has_eyes:
        memory, present = make_caches(root, config, load_sight(config, weights), _text_encoder(config), **how)
        return (memory or next(iter(present.values()))).folder
    perception = load_perception(config, weights)
    return _build(root, config, perception, **how)


def open_frames(root: Path, config: MemobenchMemConfig, perception: Perception) -> FrameLookup:
    """Open what training looks up of the dataset at ``root``.

    Raises:
        MemobenchError: the dataset lacks a column, or a cache cannot be made.
    """
    if isinstance(perception, PixelPerception):
        if config.memory == "none":
            return RecordedTexts(root, read_frame_table(root))
        return open_cache(root, config, perception)
    names = [name for name in RECORDED if name != OBS_ENV_STATE] if config.sees_pictures else RECORDED
    if isinstance(perception, EyePerception):
        return open_pictures(root, config, perception, _text_encoder(config), names)
    columns, table = read_recorded(root, names)
    if isinstance(perception, FoundObjects):
        columns[FOUND] = found_in(root, config, perception.look, _text_encoder(config))
    phase = torch.from_numpy(table.phase)
    logger.info("%d frames of %s are read into memory", table.episodes[-1], root)
    return RecordedFrames(
        root,
        columns,
        table,
        _text_encoder(config),
        remember=lambda seen, frames: perception.remember(
            {**seen, OBS_RAW_STATE: seen[OBS_STATE], OBS_PHASE: phase}, frames
        ),
        key=perception.key,
        stride=config.memory_stride,
    )


def open_cache(root: Path, config: MemobenchMemConfig, perception: PixelPerception) -> FeatureCache:
    """Open the cache that ``config`` reads of the dataset at ``root``; make or finish it first where that is needed.

    Of several processes (the ranks of a training run) one makes it, and the others wait.

    Raises:
        MemobenchError: it cannot be made, for want of room say.
    """
    folder = _build(
        root,
        config,
        perception,
        progress=lambda done, count: logger.info("feature cache: %d of %d episodes", done, count),
    )
    return FeatureCache.open(
        root,
        folder.name,
        frames_key=perception.key,
        camera=_column(root, perception),
        stride=config.memory_stride,
        texts_key=None if config.align == "none" else _text_encoder(config).key,
        place=folder.parent,
    )


def _build(root: Path, config: MemobenchMemConfig, perception: PixelPerception, **how: Any) -> Path:
    """Make or finish the cache of what ``perception`` remembers, beside the dataset or where ``config`` says."""
    seen: dict[str, Any] = {"camera": _column(root, perception), "stride": config.memory_stride}
    folder = find_cache(root, config.cache_name, frames_key=perception.key, place=config.cache_place, **seen)
    return build_feature_cache(root, folder.name, perception, _text_encoder(config), place=folder.parent, **seen, **how)


def _column(root: Path, perception: PixelPerception) -> str:
    """Return the dataset's column that is remembered: its first camera, where the policy has not chosen yet."""
    return name_in_data(perception.remembers) or next(iter(cameras_of(root)), "")


def _text_encoder(config: MemobenchMemConfig) -> WordTextEncoder | SiglipTextEncoder:
    assert config.text_encoder is not None  # set by the configuration
    return make_text_encoder(config.text_encoder, config.dimensions.text_dim, str(config.device))
