"""The feature cache of a dataset, made and opened with the frozen towers of a policy."""

from __future__ import annotations

import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.building import FrameEncoder, Progress, build_feature_cache, require_room
from lerobot_memobench.datasets.feature_cache.frames import FrameReader, TextEncoder, frame_reader, read_frame_table
from lerobot_memobench.datasets.feature_cache.layout import find_cache
from lerobot_memobench.datasets.feature_cache.reading import (
    FeatureCache,
    FrameLookup,
    RecordedFrames,
    RecordedTexts,
    read_recorded,
)
from lerobot_memobench.datasets.lerobot_format.layout import read_info
from lerobot_memobench.envs.prompting import name_in_data
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import in_words
from lerobot_memobench.perception.visual_encoder import GRID, POOLED, WIDTH, VisualEncoder
from lerobot_memobench.perception.weights import load_detector, load_visual_encoder
from lerobot_memobench.policies.memobench_mem.checkpoints import load_exactly, read_weights
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    encoded_key,
    seed_parameters,
)
from lerobot_memobench.policies.memobench_mem.language import (
    SiglipTextEncoder,
    WordTextEncoder,
    make_text_encoder,
)
from lerobot_memobench.policies.memobench_mem.network import SizedPaliGemmaWithExpert
from lerobot_memobench.policies.memobench_mem.objects import (
    DETECTED,
    OBS_PHASE,
    OBS_RAW_STATE,
    VIEWS,
    DetectionEncoder,
    ObjectsFromPictures,
)
from lerobot_memobench.sim.object_layout import SIZE

logger = logging.getLogger(__name__)

RECORDED = (OBS_STATE, OBS_ENV_STATE, ACTION, "timestamp", "frame_index", "episode_index", "task_index", "index")
"""Columns that a policy which sees objects learns from."""

_VISION_PREFIX = "paligemma_with_expert.paligemma.model."


def load_token_encoder(config: MemobenchMemConfig, weights: str | Path | None = None) -> VisualTokenEncoder:
    """Load the tower of ``config``'s eyes alone; arguments and errors as of `load_image_tower`."""
    source = weights or config.base_weights
    if source is None:
        assert config.visual_encoder is not None  # asked of a configuration that has one
        tower = load_visual_encoder(config.visual_encoder)
    else:
        tower = VisualEncoder(folded=True).eval()
        load_exactly(tower, read_weights(source, _VISION_PREFIX + "vision_tower."), source, optional=set())
    width = config.dimensions.vlm.width
    return VisualTokenEncoder(tower.to(config.device), [*config.image_features], config.memory_camera or "", width)


def load_image_tower(config: MemobenchMemConfig, weights: str | Path | None = None) -> ImageTowerEncoder:
    """Load the frozen image tower of ``config``'s size alone, without the rest of the model.

    Args:
        weights: folder or repository of a pi0.5 or memobench_mem checkpoint; None takes ``config.base_weights``, or
            the fixed-seed tower when there are none.

    Raises:
        MemobenchError: the weights cannot be read or do not fit, or there is no tower.
    """
    if config.uses_objects:
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
    return ImageTowerEncoder(tower, projector, config.image_size, config.memory_camera or "")


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
        weights: checkpoint whose image tower is used, see :func:`load_image_tower`.
        workers: threads that decode videos ahead of the tower; by the cores of the machine when None.
        progress: called with (episodes done, episodes in all).
        tell: told where it lies and how large it will be, before it is made.

    Returns:
        The cache's folder, ``<root>/feature_cache/<size>-stride<n>-<hash>``, or below ``config.feature_cache_dir``; with
        eyes that of the memory's, beside which those of the present lie.
    """
    config.memory_camera = config.memory_camera or next(iter(cameras_of(root)), None)
    how: dict[str, Any] = {"batch_size": batch_size, "workers": workers, "progress": progress, "tell": tell}
    if config.uses_detector:
        assert config.detector is not None
        return make_detections(
            root, config, ObjectsFromPictures(load_detector(config.detector)), _text_encoder(config), **how
        ).folder
    if config.encodes_ahead:
        memory, present = make_caches(root, config, load_token_encoder(config, weights), _text_encoder(config), **how)
        return (memory or next(iter(present.values()))).folder
    perception = load_image_tower(config, weights)
    return _build(root, config, perception, **how)


def open_frames(root: Path, config: MemobenchMemConfig, perception: ObservationEncoder) -> FrameLookup:
    """Open what training looks up of the dataset at ``root``.

    Raises:
        MemobenchError: the dataset lacks a column, or a cache cannot be made.
    """
    if isinstance(perception, ImageTowerEncoder):
        if config.memory == "none":
            return RecordedTexts(root, read_frame_table(root))
        return open_cache(root, config, perception)
    names = [name for name in RECORDED if name != OBS_ENV_STATE] if config.uses_pictures else RECORDED
    if isinstance(perception, VisualTokenEncoder):
        return open_pictures(root, config, perception, _text_encoder(config), names)
    columns, table = read_recorded(root, names)
    if isinstance(perception, DetectionEncoder):
        columns[DETECTED] = detections_of(root, config, perception.look, _text_encoder(config))
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


def open_cache(root: Path, config: MemobenchMemConfig, perception: ImageTowerEncoder) -> FeatureCache:
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


def _build(root: Path, config: MemobenchMemConfig, perception: ImageTowerEncoder, **how: Any) -> Path:
    """Make or finish the cache of what ``perception`` remembers, beside the dataset or where ``config`` says."""
    seen: dict[str, Any] = {"camera": _column(root, perception), "stride": config.memory_stride}
    folder = find_cache(root, config.cache_name, frames_key=perception.key, place=config.cache_place, **seen)
    return build_feature_cache(root, folder.name, perception, _text_encoder(config), place=folder.parent, **seen, **how)


def _column(root: Path, perception: ImageTowerEncoder) -> str:
    """Return the dataset's column that is remembered: its first camera, where the policy has not chosen yet."""
    return name_in_data(perception.memory_input) or next(iter(cameras_of(root)), "")


def _text_encoder(config: MemobenchMemConfig) -> WordTextEncoder | SiglipTextEncoder:
    assert config.text_encoder is not None  # set by the configuration
    return make_text_encoder(config.text_encoder, config.dimensions.text_dim, str(config.device))


# ==== seen_pictures.py
# What eyes see in a dataset, made once: all tokens of every picture, and pooled ones of what is remembered.
#
# Both are feature caches (`datasets.feature_cache`), so they are found, finished, waited for and refused alike: one of each
# camera's present pictures, at every frame, and the memory's. The memory's is pooled from its camera's, so no video is
# decoded twice. Training samples are then made of the dataset's columns in main memory and of tokens that are read where
# they lie (`recorded_items`).


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
    encoder: VisualTokenEncoder,
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
    wanted = _wanted(root, config, encoder, cameras_of(root))
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


def _wanted(
    root: Path, config: MemobenchMemConfig, encoder: VisualTokenEncoder, cameras: Sequence[str]
) -> list[Wanted]:
    """Return the caches: of the present of each camera, and last the memory's, where something is remembered."""

    def wanted(name: str, stride: int, begins: str, tokens: Tokens) -> Wanted:
        camera = name_in_data(name)
        where: dict[str, Any] = {"camera": camera, "stride": stride, "place": config.cache_place}
        return Wanted(name, camera, stride, tokens, find_cache(root, begins, frames_key=tokens.key, **where))

    whole = Tokens(encoder.present_key, GRID**2, encoder.encode)
    pooled = Tokens(encoder.key, encoder.tokens_per_frame, encoder.pooled)
    seen = dict.fromkeys(encoder.cameras or [*cameras, encoder.memory_input])
    present = [wanted(camera, 1, f"{config.size}-present", whole) for camera in seen]
    if config.memory == "none":
        return present
    return [*present, wanted(encoder.memory_input, config.memory_stride, config.cache_name, pooled)]


def _bytes(cache: Wanted, frames: int) -> int:
    """Return about how large a cache is; each episode may remember one frame more."""
    return -(-frames // cache.stride) * cache.tokens.tokens_per_frame * cache.tokens.dim * 2


def open_pictures(
    root: Path,
    config: MemobenchMemConfig,
    encoder: VisualTokenEncoder,
    texts: TextEncoder,
    names: Sequence[str],
) -> RecordedFrames:
    """Open what training looks up of the dataset at ``root``: its columns ``names``, and what ``eyes`` see.

    Raises:
        MemobenchError: the dataset lacks a column, or a cache cannot be made.
    """
    memory, present = make_caches(
        root, config, encoder, texts, progress=lambda done, count: logger.info("seen: %d of %d episodes", done, count)
    )
    columns, table = read_recorded(root, names)
    columns |= {encoded_key(camera): cache.all_tokens() for camera, cache in present.items()}

    def remember(_: Any, frames: Sequence[int]) -> Tensor:
        """Return what is remembered of frames of one episode, by their global numbers."""
        if memory is None:  # training asks for none; a sample's shape is asked for all the same
            return torch.zeros(len(frames), encoder.tokens_per_frame, WIDTH)
        episode, first = memory.locate(frames[0])
        return memory.tokens(episode, [(first + frame - frames[0]) // memory.meta.stride for frame in frames])

    return RecordedFrames(root, columns, table, texts, remember=remember, key=encoder.key, stride=config.memory_stride)


# ==== found_in_pictures.py
# What eyes find in a dataset's pictures, made once for every frame: a feature cache of slots instead of tokens.
#
# A cache holds bfloat16 numbers, which know places to 4 mm. So a slot's number is kept as two: what it is rounded to, and
# what that leaves of it.


Look = tuple[dict[str, Tensor], Tensor]
"""Pictures of some frames by their names, and the robot's states."""


@dataclass
class DetectionFeatures:
    """What makes a cache's numbers; a `FrameEncoder`."""

    look: ObjectsFromPictures
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


def make_detections(
    root: Path, config: MemobenchMemConfig, look: ObjectsFromPictures, texts: TextEncoder, **how: Any
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
    build_feature_cache(root, folder.name, DetectionFeatures(look), texts, read=_reader(root), **where, **how)
    return FeatureCache.open(root, folder.name, frames_key=look.key, **where)


def _reader(root: Path) -> FrameReader:
    """Return what reads frames of all cameras, and the states at them."""
    readers = {name: frame_reader(root, name) for name in VIEWS}
    recorded = functools.cache(
        lambda: read_recorded(root, [OBS_STATE])
    )  # read when a frame is: a whole cache needs none

    def read(episode: int, numbers: list[int]) -> Look:
        columns, table = recorded()
        states = columns[OBS_STATE][[int(table.episodes[episode]) + number for number in numbers]]
        return {name: one(episode, numbers) for name, one in readers.items()}, states

    return read


def detections_of(
    root: Path, config: MemobenchMemConfig, look: ObjectsFromPictures, texts: TextEncoder, **how: Any
) -> Tensor:
    """Return what is found at every frame of the dataset at ``root``, (N, SIZE) float32; all else as `make_detections`."""

    def tell(done: int, count: int) -> None:
        logger.info("objects found in %d of %d episodes", done, count)

    return make_detections(root, config, look, texts, progress=tell, **how).all_tokens().sum(dim=1, dtype=torch.float32)
