"""Features of a dataset that a policy learns from, made once with its frozen encoders and opened for training.

All are feature caches (`datasets.feature_cache`), so they are found, finished, waited for and refused alike:

- the image tower's pooled tokens of remembered pictures (`ImageTowerEncoder`);
- a visual encoder's tokens of every present picture of each camera, and pooled ones of remembered pictures, which are
  made of the former, so no video is decoded twice (`VisualTokenEncoder`);
- thumbnails of remembered pictures, for a memory of what moves, whatever the policy's size;
- a detector's slots at every frame (`DetectionEncoder`). A cache holds bfloat16 numbers, which know places to 4 mm; so
  each number is kept as two: what it is rounded to, and the rest.

Privileged object state is read from the dataset's columns.
"""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_STATE
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.building import Progress, build_feature_cache, require_room
from lerobot_memobench.datasets.feature_cache.frames import frame_reader, read_frame_table
from lerobot_memobench.datasets.feature_cache.layout import find_cache
from lerobot_memobench.datasets.feature_cache.reading import (
    FeatureCache,
    FrameLookup,
    RecordedFrames,
    RecordedTexts,
    read_recorded,
)
from lerobot_memobench.datasets.lerobot_format.layout import read_info
from lerobot_memobench.envs.command_line import name_in_data
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import in_words
from lerobot_memobench.perception.visual_encoder import GRID, WIDTH, VisualEncoder
from lerobot_memobench.perception.weights import load_detector, load_visual_encoder
from lerobot_memobench.policies.memobench_mem.alignment import SiglipTextEncoder, WordTextEncoder, make_text_encoder
from lerobot_memobench.policies.memobench_mem.backbone import make_backbone
from lerobot_memobench.policies.memobench_mem.checkpoints import load_exactly, read_weights
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.encoders import (
    THUMBNAIL,
    THUMBNAILS,
    VISION_SEED,
    ImageTowerEncoder,
    ObservationEncoder,
    VisualTokenEncoder,
    encoded_key,
    seed_parameters,
    thumbnails,
)
from lerobot_memobench.policies.memobench_mem.objects import (
    DETECTED,
    OBS_RAW_STATE,
    VIEWS,
    DetectionEncoder,
    ObjectsFromPictures,
)
from lerobot_memobench.protocol import OBS_PHASE
from lerobot_memobench.sim.object_layout import SIZE

logger = logging.getLogger(__name__)

RECORDED = (OBS_STATE, OBS_ENV_STATE, ACTION, "timestamp", "frame_index", "episode_index", "task_index", "index")
"""Columns that samples are made of where training decodes no video."""
_VISION_PREFIX = "paligemma_with_expert.paligemma.model."


def open_frames(root: Path, config: MemobenchMemConfig, encoder: ObservationEncoder) -> FrameLookup:
    """Open what training looks up of the dataset at ``root``; make or finish caches first where that is needed.

    Of several processes (the ranks of a training run) one makes a cache, and the others wait.

    Raises:
        MemobenchError: the dataset lacks a column, or a cache cannot be made.
    """
    if isinstance(encoder, ImageTowerEncoder):
        if config.memory == "none":
            return RecordedTexts(root, read_frame_table(root))
        if config.remembers_thumbnails:
            return make_thumbnails(root, config, progress=_logged("thumbnails: %d of %d episodes"))
        return open_cache(root, config, encoder, progress=_logged("feature cache: %d of %d episodes"))
    names = [name for name in RECORDED if name != OBS_ENV_STATE] if config.uses_pictures else RECORDED
    if isinstance(encoder, VisualTokenEncoder):
        return _with_picture_tokens(root, config, encoder, names)
    columns, table = read_recorded(root, names)
    if isinstance(encoder, DetectionEncoder):
        progress = _logged("objects detected in %d of %d episodes")
        halves = make_detections(root, config, encoder.detect, progress=progress).all_tokens()
        columns[DETECTED] = halves.sum(dim=1, dtype=torch.float32)
    logger.info("%d frames of %s are read into memory", table.episodes[-1], root)
    observed = {**columns, OBS_RAW_STATE: columns[OBS_STATE], OBS_PHASE: torch.from_numpy(table.phase)}
    return RecordedFrames(
        root,
        columns,
        table,
        _text_encoder(config),
        remember=functools.partial(encoder.remember, observed),
        key=encoder.key,
        stride=config.memory_stride,
    )


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
        weights: model checkpoint whose image tower or visual encoder is used, see `load_image_tower`.
        workers: threads that decode videos ahead of the encoder; by the cores of the machine when None.
        progress: called with (episodes done, episodes in all).
        tell: called with the cache's place and size before it is made.

    Returns:
        The cache's folder, ``<root>/feature_cache/<size>-stride<n>-<hash>``, or below ``config.feature_cache_dir``;
        with a visual encoder that of the memory, beside which those of the present lie.

    Raises:
        MemobenchError: the dataset lacks a camera, the disk has no room, or the policy needs no cache.
    """
    config.memory_camera = config.memory_camera or next(iter(cameras_of(root)), None)
    how: dict[str, Any] = {"batch_size": batch_size, "workers": workers, "progress": progress, "tell": tell}
    if config.detector is not None:
        return make_detections(root, config, ObjectsFromPictures(load_detector(config.detector)), **how).folder
    if config.uses_visual_encoder:
        memory, present = make_caches(root, config, load_token_encoder(config, weights), **how)
        return (memory or next(iter(present.values()))).folder
    if config.remembers_thumbnails:
        return make_thumbnails(root, config, **how).folder
    return open_cache(root, config, load_image_tower(config, weights), **how).folder


def cameras_of(root: Path) -> list[str]:
    """Return the cameras of a dataset, in its order."""
    features = read_info(root)["features"].items()
    return [name for name, feature in features if feature.get("dtype") in ("video", "image")]


def _text_encoder(config: MemobenchMemConfig) -> WordTextEncoder | SiglipTextEncoder:
    name = "words" if config.align == "none" else config.text_encoder  # without an alignment nothing reads the vectors
    assert name is not None  # set by the configuration
    return make_text_encoder(name, config.dimensions.text_dim, str(config.device))


def _logged(message: str) -> Progress:
    return lambda done, count: logger.info(message, done, count)


@dataclass(frozen=True)
class Features:
    """Features of a frame, as a `FrameEncoder`: their identity, number and width, and what makes them of frames."""

    key: str
    tokens_per_frame: int
    dim: int
    make: Callable[..., Tensor]

    def __call__(self, frames: Any) -> Tensor:
        """Return them, (N, tokens_per_frame, dim) bfloat16."""
        return self.make(frames)


def _folder(root: Path, config: MemobenchMemConfig, key: str, begins: str, camera: str, stride: int) -> Path:
    return find_cache(root, begins, frames_key=key, camera=camera, stride=stride, place=config.cache_place)


def _made(
    root: Path,
    config: MemobenchMemConfig,
    frames: Features | ImageTowerEncoder,
    begins: str,
    camera: str,
    stride: int,
    *,
    texts_key: str | None = None,
    **how: Any,
) -> FeatureCache:
    """Make or finish a cache of a camera of the dataset, and open it; ``how`` is of `build_feature_cache`."""
    folder = _folder(root, config, frames.key, begins, camera, stride)
    where: dict[str, Any] = {"camera": camera, "stride": stride, "place": folder.parent}
    build_feature_cache(root, folder.name, frames, _text_encoder(config), **where, **how)
    return FeatureCache.open(root, folder.name, frames_key=frames.key, texts_key=texts_key, **where)


# -- the image tower -------------------------------------------------------------------------------------------------


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
            "perception=objects needs no feature cache where the environment gives the objects: training reads the "
            "dataset's columns; leave this command out, or name a detector."
        )
    with torch.device("meta"):
        model = make_backbone(config).paligemma.model
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


def open_cache(root: Path, config: MemobenchMemConfig, encoder: ImageTowerEncoder, **how: Any) -> FeatureCache:
    """Open the cache of pooled tokens of the dataset at ``root``; make or finish it first where that is needed.

    Args:
        how: of `build_feature_cache`.

    Raises:
        MemobenchError: it cannot be made, for want of room say.
    """
    camera = name_in_data(encoder.memory_input) or next(iter(cameras_of(root)), "")  # where none is chosen yet
    texts_key = None if config.align == "none" else _text_encoder(config).key
    where = config.cache_name, camera, config.memory_stride
    return _made(root, config, encoder, *where, texts_key=texts_key, **how)


# -- thumbnails ------------------------------------------------------------------------------------------------------


SMALL = Features(THUMBNAILS, 1, THUMBNAIL**2, thumbnails)


def make_thumbnails(root: Path, config: MemobenchMemConfig, **how: Any) -> FeatureCache:
    """Make or finish the cache of thumbnails of the camera that is remembered, and open it.

    Args:
        how: of `build_feature_cache`.

    Raises:
        MemobenchError: the dataset lacks the camera, or the disk has no room.
    """
    camera = name_in_data(config.memory_camera or "") or next(iter(cameras_of(root)), "")
    texts_key = None if config.align == "none" else _text_encoder(config).key
    where = _thumbnails_name(config), camera, config.memory_stride
    return _made(root, config, SMALL, *where, texts_key=texts_key, **how)


def _thumbnails_name(config: MemobenchMemConfig) -> str:
    return f"thumbnails-stride{config.memory_stride}"


# -- visual encoders -------------------------------------------------------------------------------------------------


def load_token_encoder(config: MemobenchMemConfig, weights: str | Path | None = None) -> VisualTokenEncoder:
    """Load ``config``'s visual encoder alone; arguments and errors as of `load_image_tower`."""
    source = weights or config.base_weights
    if source is None:
        assert config.visual_encoder is not None  # asked of a configuration that has one
        tower = load_visual_encoder(config.visual_encoder)
    else:
        tower = VisualEncoder(folded=True).eval()
        load_exactly(tower, read_weights(source, _VISION_PREFIX + "vision_tower."), source, optional=set())
    width = config.dimensions.vlm.width
    return VisualTokenEncoder(tower.to(config.device), [*config.image_features], config.memory_camera or "", width)


def make_caches(
    root: Path,
    config: MemobenchMemConfig,
    encoder: VisualTokenEncoder,
    *,
    tell: Callable[[str], None] = logger.info,
    **how: Any,
) -> tuple[FeatureCache | None, dict[str, FeatureCache]]:
    """Make or finish the tokens of the dataset at ``root``; their size is logged before.

    Args:
        how: of `build_feature_cache`.

    Returns:
        The memory's cache, None where nothing is remembered, and those of the present pictures by their cameras' names
        at the policy.

    Raises:
        MemobenchError: the dataset lacks a camera, or the disk has no room for all of them.
    """

    whole = Features(encoder.present_key, GRID**2, WIDTH, encoder.encode)
    small = config.remembers_thumbnails
    pooled = SMALL if small else Features(encoder.key, encoder.tokens_per_frame, WIDTH, encoder.pooled)
    cameras = dict.fromkeys(encoder.cameras or [*cameras_of(root), encoder.memory_input])
    present = {camera: (whole, f"{config.size}-present", name_in_data(camera), 1) for camera in cameras}
    begins = _thumbnails_name(config) if small else config.cache_name
    memory = (pooled, begins, name_in_data(encoder.memory_input), config.memory_stride)
    remembers = config.memory != "none"
    frames = int(read_info(root).get("total_frames", 0))
    sizes = {  # about; each episode may remember one frame more
        _folder(root, config, made.key, begins, camera, stride): -(-frames // stride)
        * made.tokens_per_frame
        * made.dim
        * 2
        for made, begins, camera, stride in (*present.values(), *([memory] if remembers else []))
    }
    tell(
        f"The tokens of the {frames:,} frames of {root} take {in_words(sum(sizes.values()))}: "
        f"{in_words(2 * GRID**2 * WIDTH)} of each of {len(present)} pictures of a frame, and "
        f"{in_words(2 * pooled.tokens_per_frame * pooled.dim)} of every frame that is remembered; what is not there "
        "yet is made now."
    )
    require_room(next(iter(sizes)).parent, sizes)
    opened, how["tell"] = {}, tell
    for camera, wanted in present.items():
        # Whoever trains beside us may be at it; the other camera's is made here meanwhile.
        with contextlib.suppress(_Busy):
            opened[camera] = _made(root, config, *wanted, wait=_come_back, **how)
    for camera in [camera for camera in present if camera not in opened]:
        opened[camera] = _made(root, config, *present[camera], **how)
    if not remembers:
        return None, opened
    read = None if small else opened[encoder.memory_input].tokens
    return _made(root, config, *memory, read=read, **how), opened


class _Busy(Exception):
    """Another process is making this."""


def _come_back(folder: Path) -> None:
    """Wait for no other process: a ``wait`` of `build_feature_cache`."""
    raise _Busy(folder)


def _with_picture_tokens(
    root: Path, config: MemobenchMemConfig, encoder: VisualTokenEncoder, names: Sequence[str]
) -> RecordedFrames:
    """Open a dataset's columns ``names``, and beside them the tokens of its pictures."""
    memory, present = make_caches(root, config, encoder, progress=_logged("pictures encoded: %d of %d episodes"))
    columns, table = read_recorded(root, names)
    columns |= {encoded_key(camera): cache.all_tokens() for camera, cache in present.items()}

    def remember(frames: Sequence[int]) -> Tensor:
        """Return the pooled tokens of frames of one episode, by their global numbers."""
        if memory is None:  # training asks for none; a sample's shape is asked for all the same
            return torch.zeros(len(frames), encoder.tokens_per_frame, WIDTH)
        episode, first = memory.locate(frames[0])
        return memory.tokens(episode, [(first + frame - frames[0]) // memory.meta.stride for frame in frames])

    texts = _text_encoder(config)
    return RecordedFrames(root, columns, table, texts, remember=remember, key=encoder.key, stride=config.memory_stride)


# -- detectors -------------------------------------------------------------------------------------------------------


def make_detections(root: Path, config: MemobenchMemConfig, detect: ObjectsFromPictures, **how: Any) -> FeatureCache:
    """Make or finish the cache of detections in the pictures of the dataset at ``root``.

    Args:
        how: of `build_feature_cache`.

    Raises:
        MemobenchError: the dataset lacks a camera, or the disk has no room.
    """
    readers = {name: frame_reader(root, name_in_data(name)) for name in VIEWS}
    measured = name_in_data(OBS_STATE)
    recorded = functools.cache(lambda: read_recorded(root, [measured]))  # a cache that is whole needs none

    def read(episode: int, numbers: list[int]) -> tuple[dict[str, Tensor], Tensor]:
        columns, table = recorded()
        states = columns[measured][[int(table.episodes[episode]) + number for number in numbers]]
        return {name: one(episode, numbers) for name, one in readers.items()}, states

    def make(observed: tuple[dict[str, Tensor], Tensor]) -> Tensor:
        slots = detect(*observed)
        rounded = slots.to(torch.bfloat16)
        return torch.stack([rounded, (slots - rounded.float()).to(torch.bfloat16)], dim=1)

    features = Features(detect.key, 2, SIZE, make)
    return _made(root, config, features, "objects", name_in_data(next(iter(VIEWS))), 1, read=read, **how)
