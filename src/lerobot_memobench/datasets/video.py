"""Encode camera frames as MP4, as LeRobot stores them, and compute statistics of their pixels.

Encoding: H.264, preset ultrafast, one key frame in ten, CRF 23, no B-frames. Measured on an episode of the
benchmark (396 frames of 256×256, one encoder thread, on busy cores; third person / wrist):

==========================  =============  =================================  ===================
setting                     frames/s       PSNR mean (worst frame), dB        bytes per frame
==========================  =============  =================================  ===================
LeRobot's default, AV1 g=2  204 / 224      36.6 (34.2) / 37.6 (32.6)          3,965 / 1,999
AV1, g=20                   291 / 351      36.5 (34.2) / 36.3 (32.2)          1,675 / 1,333
H.264, CRF 30, g=2          599 / 527      32.4 (30.2) / 34.7 (30.7)          1,643 / 1,005
this one                    2,011 / 1,722  37.6 (36.4) / 39.3 (34.6)          3,151 / 2,479
==========================  =============  =================================  ===================

So both cameras together are smaller than with LeRobot's default, closer to the rendered images, and encoded several
times as fast. g=10 keeps random access cheap (at most nine small frames are decoded before the requested one); H.264
in yuv420p plays in every browser, so the hub's viewer shows it. Frames go from memory into the encoder: LeRobot's
recording loop spends most of its time writing PNG files.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_memobench.constants import CONTROL_HZ
from lerobot_memobench.datasets.episodes import naming_damage, undamaged
from lerobot_memobench.datasets.layout import without_pattern
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def _encoder() -> RGBEncoderConfig:
    from lerobot.configs import RGBEncoderConfig

    return RGBEncoderConfig(vcodec="h264", preset="ultrafast", g=10, crf=23, extra_options={"bf": 0})


class VideoWriter:
    """Encode a video of ``rate`` frames/s frame by frame, so that an episode's images are never in memory together."""

    def __init__(self, path: Path, rate: int = CONTROL_HZ) -> None:
        self._path, self._rate = path, rate
        self._container: Any = None
        self._stream: Any = None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Encode the next frame, (H, W, 3) uint8."""
        import av

        if self._container is None:
            encoder = _encoder()
            # With one thread the bytes do not depend on the machine's cores or on other processes.
            options = encoder.get_codec_options(1, as_strings=True)
            self._container = av.open(str(self._path), "w")
            self._stream = self._container.add_stream(encoder.vcodec, self._rate, options=options)
            self._stream.pix_fmt = encoder.pix_fmt
            self._stream.height, self._stream.width = frame.shape[:2]
        image = av.VideoFrame.from_ndarray(frame, format="rgb24")
        self._container.mux(self._stream.encode(image))

    def close(self, flush: bool = True) -> None:
        """Flush the encoder and end the file; without ``flush`` the file is unusable."""
        if self._container is not None:
            if flush:
                self._container.mux(self._stream.encode())
            self._container.close()
            self._container = None


def mirror_video(source: Path, path: Path, rate: int) -> None:
    """Encode a video of ``rate`` frames/s again, with each frame mirrored left to right."""
    import av

    writer = VideoWriter(path, rate)
    with av.open(str(source)) as container:
        for frame in container.decode(video=0):
            writer.add(np.ascontiguousarray(frame.to_ndarray(format="rgb24")[:, ::-1]))
    writer.close()


def join_videos(videos: Sequence[tuple[Path, int]], path: Path) -> None:
    """Join videos of one encoder, given with their numbers of frames, without encoding them again."""
    import av

    with av.open(str(path), "w", options={"movflags": "faststart"}) as target:
        stream: Any = None
        offset = 0
        for part, frames in videos:
            with av.open(str(part)) as source:
                template = source.streams.video[0]
                assert template.time_base is not None
                if stream is None:
                    stream = target.add_stream_from_template(template, opaque=True)
                    stream.time_base = time_base = template.time_base
                for packet in source.demux(template):
                    if packet.dts is None or packet.pts is None:
                        continue  # the demuxer's last, empty packet
                    packet.pts += offset
                    packet.dts += offset
                    packet.stream = stream
                    target.mux(packet)
            offset += round(frames / (CONTROL_HZ * time_base))  # the files' own durations are not exactly i / 20 s


def video_info(path: Path) -> dict[str, Any]:
    """Return LeRobot's description of a video for meta/info.json."""
    import av
    from lerobot.datasets.video_utils import get_video_info

    level = av.logging.get_level()
    try:
        return get_video_info(path, video_encoder=_encoder())
    finally:
        av.logging.set_level(level)  # LeRobot leaves FFmpeg printing to stderr


Stats = dict[str, NDArray]
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)


class ImageHistograms:
    """Collect a histogram of 256 bins per channel of each frame, for statistics of an episode."""

    # LeRobot samples frames evenly over the episode, so the sample is known only at its end. The histograms of a frame
    # take 3 kB, the frame itself 192 kB.

    def __init__(self) -> None:
        self._counts: list[NDArray[np.int32]] = []
        self._frame: NDArray[np.uint8] | None = None

    def add(self, frame: NDArray[np.uint8]) -> None:
        """Add the next frame, (H, W, 3) uint8."""
        import cv2

        if self._frame is not None and np.array_equal(frame, self._frame):  # most frames of a strict task are held
            self._counts.append(self._counts[-1])
            return
        counts = [cv2.calcHist([frame], [channel], None, [256], [0, 256])[:, 0] for channel in range(3)]
        self._counts.append(np.array(counts, dtype=np.int32))
        self._frame = frame.copy()

    def stats(self, *, sampled: bool = False) -> Stats:
        """Return LeRobot's statistics: each (3, 1, 1), in [0, 1], and ``count`` (1,), exact over the pixels.

        They are of LeRobot's sample of the added frames; ``sampled``: the added frames are the sample.
        """
        from lerobot.datasets.compute_stats import sample_indices

        chosen = range(len(self._counts)) if sampled else sample_indices(len(self._counts))
        counts = np.stack([self._counts[index] for index in chosen]).sum(axis=0, dtype=np.int64)
        levels, total = np.arange(256) / 255.0, counts[0].sum()
        mean = counts @ levels / total
        cumulative = counts.cumsum(axis=1)
        stats = {
            "min": levels[(counts > 0).argmax(axis=1)],
            "max": levels[255 - (counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(counts @ levels**2 / total - mean**2, 0)),
        }
        for q in QUANTILES:
            stats[f"q{int(q * 100):02d}"] = levels[(cumulative >= q * total).argmax(axis=1)]
        return {name: value.reshape(3, 1, 1) for name, value in stats.items()} | {"count": np.array([len(chosen)])}


TOLERANCE = 1e-4  # largest difference of a decoded frame to its time, s
FrameReader = Callable[[int, list[int]], Any]
"""From (episode, frame numbers) to images (n, 3, H, W) float32 in [0, 1], or to another input of an encoder."""


def frame_reader(root: Path, camera: str) -> FrameReader:
    """Return the reader of a camera of the dataset in ``root``; it decodes the frames of a call in one sweep."""
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    with naming_damage(root):
        meta = LeRobotDatasetMetadata(root.name, root=without_pattern(root))
    if not meta.camera_keys:
        raise MemobenchError(
            f"{root} holds no images, which a detector and perception=pixels need; name a dataset with images, or "
            "leave detector out with perception=objects"
        )
    if camera not in meta.camera_keys:
        raise MemobenchError(
            f"The dataset {root} has no camera '{camera}'; it has {', '.join(meta.camera_keys)}. "
            "Choose one with --policy.memory_camera."
        )
    if camera not in meta.video_keys:
        return _image_reader(root, camera, meta)
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
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=without_pattern(root))
    starts = meta.episodes["dataset_from_index"]
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            return torch.stack([dataset[starts[episode] + number][camera] for number in numbers])

    return read
