"""Decode images of a dataset's camera."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lerobot_memobench.datasets.lerobot_format.damage import naming_damage
from lerobot_memobench.datasets.lerobot_format.layout import without_pattern
from lerobot_memobench.datasets.lerobot_format.tables import undamaged
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

TOLERANCE = 1e-4
"""Largest difference of a decoded frame to its time, s."""
FrameReader = Callable[[int, list[int]], Any]
"""From (episode, frame numbers) to images (n, 3, H, W) float32 in [0, 1], or to another input of an encoder."""


def frame_reader(root: Path, camera: str) -> FrameReader:
    """Return the reader of a camera of the dataset in ``root``; it decodes the frames of a call in one sweep.

    Raises:
        MemobenchError: the dataset has no such camera or no images, or its metadata is damaged.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    with naming_damage(root):
        meta = LeRobotDatasetMetadata(root.name, root=without_pattern(root))
    if not meta.camera_keys:
        raise MemobenchError(
            f"{root} holds no pictures, which a detector and perception=pixels need; name a dataset with images, or "
            "leave detector out with perception=objects"
        )
    if camera not in meta.camera_keys:
        raise MemobenchError(
            f"The dataset {root} has no camera '{camera}'; it has {', '.join(meta.camera_keys)}. "
            "Choose one with --policy.memory_camera."
        )
    return (_video_reader if camera in meta.video_keys else _image_reader)(root, camera, meta)


def _video_reader(root: Path, camera: str, meta: LeRobotDatasetMetadata) -> FrameReader:
    height, width, channels = meta.features[camera]["shape"]
    decode = _decoder()
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            row = meta.episodes[episode]
            path = root / meta.get_video_file_path(episode, camera)
        start = row[f"videos/{camera}/from_timestamp"]
        with undamaged(path):
            images = decode(path, [start + number / meta.fps for number in numbers])
            return images.reshape(len(numbers), channels, height, width)

    return read


def _decoder() -> Callable[[Path, list[float]], Tensor]:
    """Return a function from a video and times in it, s, to its frames."""
    from lerobot.datasets import video_utils

    backend = video_utils.get_safe_default_video_backend()
    own = threading.local()

    def decode(path: Path, times: list[float]) -> Tensor:
        if backend != "torchcodec":
            return video_utils.decode_video_frames(path, times, tolerance_s=TOLERANCE, backend=backend)
        # LeRobot shares decoders within a process, but two threads must not use the same one.
        if not hasattr(own, "decoders"):
            own.decoders = video_utils.VideoDecoderCache(max_size=1)
        return video_utils.decode_video_frames_torchcodec(path, times, TOLERANCE, decoder_cache=own.decoders)

    return decode


def _image_reader(root: Path, camera: str, meta: LeRobotDatasetMetadata) -> FrameReader:
    """Return the reader of a camera whose images are stored in the tables."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=without_pattern(root))
    starts = meta.episodes["dataset_from_index"]
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            return torch.stack([dataset[starts[episode] + number][camera] for number in numbers])

    return read
