"""Frames, simulator states and LeRobot's metadata of a dataset that is being written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.lerobot_format.layout import EXECUTED_ACTION, image_key, objects_column
from lerobot_memobench.datasets.lerobot_format.record import EPISODE_INFO, EpisodeRecord
from lerobot_memobench.datasets.lerobot_format.tables import ParquetFiles, frames_table, states_table
from lerobot_memobench.datasets.staging.episode import StagedEpisode
from lerobot_memobench.datasets.statistics import Stats, numeric_stats
from lerobot_memobench.protocol import CAMERAS, CONTROL_HZ

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

STATES_PATH = "states/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PER_STATES_FILE = 100


def write_frames(
    meta: LeRobotDatasetMetadata,
    episodes: Sequence[StagedEpisode],
    places: Sequence[dict[str, Any]],
    versions: Mapping[str, str] | None = None,
) -> None:
    """Write data/, states/ and the metadata; one row group per episode, files of LeRobot's size.

    Args:
        meta: of the dataset to be.
        episodes: its episodes, in their order.
        places: where each one's videos are (`write_videos`).
        versions: of the packages that made them.
    """
    from lerobot.datasets.io_utils import write_stats

    frames = _FrameWriter(meta, versions)
    for episode, place in zip(episodes, places, strict=True):
        frames.add(episode, place)
    meta.stats = frames.finish() | _image_statistics(episodes)
    write_stats(meta.stats, meta.root)


class _FrameWriter:
    """Writes episode after episode and keeps their numbers for the statistics of the whole."""

    def __init__(self, meta: LeRobotDatasetMetadata, versions: Mapping[str, str] | None) -> None:
        self._meta, self._versions = meta, versions
        self._data = ParquetFiles(meta.root, meta.data_path)
        self._states = ParquetFiles(meta.root, STATES_PATH)
        self._numbers: dict[str, list[NDArray]] = {}
        self._episodes = self._frames = 0

    def add(self, episode: StagedEpisode, place: dict[str, Any]) -> None:
        """Write an episode's rows and its metadata."""
        meta, number, start = self._meta, self._episodes, self._frames
        if self._data.size() >= meta.data_files_size_in_mb * 1024**2:
            self._data.next(meta.chunks_size)
        if number and number % EPISODES_PER_STATES_FILE == 0:
            self._states.next(meta.chunks_size)
        task = str(episode.info["language"])
        meta.save_episode_tasks([task])
        arrays = episode.arrays()
        record = EpisodeRecord.model_validate(episode.info | {"versions": self._versions})
        columns = self._columns(arrays, int(episode.info["frames"]), task, record)
        self._data.write(frames_table(columns, episode, meta.features))
        self._states.write(states_table(arrays["states"], number))
        length = len(columns["index"])
        self._episodes, self._frames = number + 1, start + length
        place = {
            "data/chunk_index": self._data.chunk,
            "data/file_index": self._data.file,
            "dataset_from_index": start,
            "dataset_to_index": start + length,
            **place,
        }
        meta.save_episode(number, length, [task], self._count(columns, episode), place | record.in_meta())

    def _columns(self, arrays: dict[str, NDArray], length: int, task: str, record: EpisodeRecord) -> dict[str, NDArray]:
        task_index = self._meta.get_task_index(task)
        assert task_index is not None
        info = np.full(length, "", dtype=object)
        info[0] = record.in_frames()
        columns: dict[str, NDArray] = {
            "observation.state": arrays["proprio"],
            "action": arrays["actions"],
            EXECUTED_ACTION: arrays.get("executed", arrays["actions"]),
            "timestamp": (np.arange(length) / CONTROL_HZ).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, self._episodes),
            "index": self._frames + np.arange(length),
            "task_index": np.full(length, task_index),
            EPISODE_INFO: info,
        }
        if "objects" in arrays:
            columns[objects_column(self._meta.features)] = arrays["objects"]
        return columns | {key: arrays[key] for key in self._meta.features if key in arrays}

    def _count(self, columns: dict[str, NDArray], episode: StagedEpisode) -> dict[str, Stats]:
        """Return the episode's statistics; keep its numbers."""
        numbers = {key: value for key, value in columns.items() if value.dtype.kind in "bif"}
        for key, value in numbers.items():
            self._numbers.setdefault(key, []).append(value)
        return {key: numeric_stats(value) for key, value in numbers.items()} | _camera_statistics(episode)

    def finish(self) -> dict[str, Stats]:
        """End the files; return exact statistics of all numbers."""
        self._data.close()
        self._states.close()
        return {key: numeric_stats(np.concatenate(values)) for key, values in self._numbers.items()}


def _camera_statistics(episode: StagedEpisode) -> dict[str, Stats]:
    return {image_key(camera): episode.image_stats(camera) for camera in CAMERAS} if episode.has_images else {}


def _image_statistics(episodes: Sequence[StagedEpisode]) -> dict[str, Stats]:
    """Return the statistics of all pixels, over the frames that were sampled of each episode."""
    from lerobot.datasets.compute_stats import aggregate_stats

    found = [_camera_statistics(episode) for episode in episodes if episode.has_images]
    return aggregate_stats(found) if found else {}
