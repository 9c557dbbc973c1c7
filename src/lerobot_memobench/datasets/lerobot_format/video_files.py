"""Episodes' videos joined into files of LeRobot's size."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lerobot_memobench.datasets.lerobot_format.layout import image_key
from lerobot_memobench.datasets.staging.episode import StagedEpisode
from lerobot_memobench.datasets.video import join_videos, video_info
from lerobot_memobench.protocol import CAMERAS, CONTROL_HZ

if TYPE_CHECKING:
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata


def write_videos(meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode]) -> list[dict[str, Any]]:
    """Join the episodes' videos below the dataset's root; return each episode's place in them."""
    from lerobot.datasets.io_utils import write_info

    places: list[dict[str, Any]] = [{} for _ in episodes]
    for camera in CAMERAS if meta.video_keys else ():
        _write_camera(meta, episodes, camera, places)
        write_info(meta.info, meta.root)
    return places


def _write_camera(
    meta: LeRobotDatasetMetadata, episodes: Sequence[StagedEpisode], camera: str, places: list[dict[str, Any]]
) -> None:
    from lerobot.datasets.utils import update_chunk_file_indices

    key, chunk, file = image_key(camera), 0, 0
    limit = meta.video_files_size_in_mb * 1024**2
    for group in _grouped([episode.video(camera).stat().st_size for episode in episodes], limit):
        assert meta.video_path is not None
        path = meta.root / meta.video_path.format(video_key=key, chunk_index=chunk, file_index=file)
        path.parent.mkdir(parents=True, exist_ok=True)
        join_videos([(episodes[i].video(camera), int(episodes[i].info["frames"])) for i in group], path)
        frames = 0
        for i in group:
            start, frames = frames, frames + int(episodes[i].info["frames"])
            places[i] |= {
                f"videos/{key}/chunk_index": chunk,
                f"videos/{key}/file_index": file,
                f"videos/{key}/from_timestamp": start / CONTROL_HZ,
                f"videos/{key}/to_timestamp": frames / CONTROL_HZ,
            }
        chunk, file = update_chunk_file_indices(chunk, file, meta.chunks_size)
        meta.features[key].setdefault("info", video_info(path))


def _grouped(sizes: Sequence[int], limit: float) -> list[list[int]]:
    """Consecutive positions whose sizes sum up to at most ``limit`` (a single larger one stands alone)."""
    groups: list[list[int]] = []
    total = 0
    for position, size in enumerate(sizes):
        if not groups or total + size > limit:
            groups.append([])
            total = 0
        groups[-1].append(position)
        total += size
    return groups
