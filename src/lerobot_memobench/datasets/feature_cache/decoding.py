"""Frames of one camera by episode and number, decoded from any thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from lerobot_memobench.datasets.lerobot_format.info import undamaged
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

TOLERANCE = 1e-4
"""Seconds by which a decoded frame may miss its time."""

FrameReader = Callable[[int, list[int]], Any]
"""From (episode, frame numbers) to images (n, 3, H, W) float32 in [0, 1], or to what an encoder is given for them."""


def frame_reader(root: Path, camera: str) -> FrameReader:
    """Return the reader of a camera of the dataset in ``root``; it decodes what it is asked for in one sweep.

    Raises:
        MemobenchError: the dataset has no such camera, or no pictures at all.
    """
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata(root.name, root=root)
    if not meta.camera_keys:
        raise MemobenchError(
            f"{root} holds no pictures, so there is nothing to encode; perception=objects needs no cache"
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
    """Function from a video and times in it, s, to its frames."""
    from lerobot.datasets import video_utils

    backend = video_utils.get_safe_default_video_backend()
    own = threading.local()

    def decode(path: Path, times: list[float]) -> Tensor:
        if backend != "torchcodec":
            return video_utils.decode_video_frames(path, times, tolerance_s=TOLERANCE, backend=backend)
        # LeRobot's decoders are shared within a process, and none may be used by two threads at a time.
        if not hasattr(own, "decoders"):
            own.decoders = video_utils.VideoDecoderCache(max_size=1)
        return video_utils.decode_video_frames_torchcodec(path, times, TOLERANCE, decoder_cache=own.decoders)

    return decode


def _image_reader(root: Path, camera: str, meta: LeRobotDatasetMetadata) -> FrameReader:
    """Reader of datasets that keep images in their tables."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=root)
    starts = meta.episodes["dataset_from_index"]
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            return torch.stack([dataset[starts[episode] + number][camera] for number in numbers])

    return read
