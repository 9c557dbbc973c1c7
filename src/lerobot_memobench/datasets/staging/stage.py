"""Write an episode: frame by frame while it is made, everything else at its end."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Collection, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.digest import digest
from lerobot_memobench.datasets.hdf5.writing import EpisodeFile, data_attributes
from lerobot_memobench.datasets.labels import labels
from lerobot_memobench.datasets.language import persistent_rows
from lerobot_memobench.datasets.staging.episode import (
    ARRAYS_FILE,
    HDF5,
    HDF5_FILE,
    LEROBOT,
    RECORD_FILE,
    StagedEpisode,
    read_staged,
)
from lerobot_memobench.datasets.staging.folders import flush_to_disk, temporary_folder
from lerobot_memobench.datasets.statistics import ImageHistograms
from lerobot_memobench.datasets.video import VideoWriter
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash
from lerobot_memobench.protocol import CAMERAS


def episode_info(demo: Demonstration) -> dict[str, Any]:
    """Return what meta/episodes, manifest and card say about an episode."""
    found = labels(demo)
    return {
        "task_name": demo.task.name,
        "memory_type": demo.task.memory_type,
        "family": demo.task.family,
        "language": demo.task.language,
        "operations": demo.task.operations,
        "seed": int(demo.seed),
        "referent": demo.referent,
        "variant": int(demo.variant),
        "success": bool(demo.success),
        "frames": len(demo),
        "exec_start_index": int(demo.exec_start),
        "key_frames": found.key_frames.tolist(),
        "scene_hash": demo.scene_hash,
        "fixture_poses": {name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
        "digest": digest(demo),
    }


class EpisodeStage:
    """An episode on its way to the disk: images frame by frame, everything else at the end.

    A context: whatever was not published when it ends leaves nothing behind.

    Args:
        folder: where the finished episode goes; the same one, if there, is kept.
        formats: which of ``FORMATS`` to write.
    """

    def __init__(self, folder: Path, formats: Collection[str] = (LEROBOT,)) -> None:
        self._folder = folder
        self._formats = tuple(formats)
        self._temporary = temporary_folder(folder)
        self._videos: dict[str, VideoWriter] = {}
        self._histograms: dict[str, ImageHistograms] = {}
        self._hdf5 = EpisodeFile(self._temporary / HDF5_FILE) if HDF5 in self._formats else None
        self._frames = 0
        if LEROBOT in self._formats:
            self._videos = {camera: VideoWriter(self._temporary / f"{camera}.mp4") for camera in CAMERAS}
            self._histograms = {camera: ImageHistograms() for camera in CAMERAS}

    def __enter__(self) -> EpisodeStage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        abandoned: list[VideoWriter | EpisodeFile] = [*self._videos.values()]
        abandoned += [] if self._hdf5 is None else [self._hdf5]
        for file in abandoned:
            with contextlib.suppress(Exception):  # on a full disk closing fails as well, and all of it is deleted
                file.abandon()
        shutil.rmtree(self._temporary, ignore_errors=True)

    def add_images(self, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Take both cameras' next frame, (H, W, 3) uint8 each."""
        self._frames += 1
        for camera, video in self._videos.items():
            video.add(images[camera])
            self._histograms[camera].add(images[camera])
        if self._hdf5 is not None:
            self._hdf5.add_images(images)

    def publish(self, demo: Demonstration) -> StagedEpisode:
        """Add everything but the images, which have been given, and make it a finished episode."""
        if self._frames not in (0, len(demo)):
            raise MemobenchError(
                f"{demo.task.name}, seed {demo.seed}: {self._frames} images of a demonstration of {len(demo)} frames "
                "were recorded; give one per frame and camera, or none"
            )
        found = labels(demo)
        info = episode_info(demo)
        _check_storable(info, found.columns())
        record = {
            "failure": None,
            "info": info,
            "language_persistent": persistent_rows(found),
            "image_stats": self._close_videos(),
        }
        if LEROBOT in self._formats:
            columns: dict[str, Any] = {"states": demo.states, "actions": demo.actions, "proprio": demo.proprio}
            columns |= {} if demo.objects is None else {"objects": demo.objects}
            columns |= {} if demo.executed is None else {"executed": demo.executed}
            columns |= {name: np.asarray(column) for name, column in found.columns().items()}
            np.savez_compressed(self._temporary / ARRAYS_FILE, **columns)
        if self._hdf5 is not None:
            self._hdf5.finish(demo)
            record["hdf5"] = data_attributes(demo.task)
        return _publish(self._temporary, self._folder, record)

    def _close_videos(self) -> dict[str, dict[str, list[Any]]]:
        """End the videos; return each camera's statistics, nothing where there were no frames."""
        for video in self._videos.values():
            video.close()
        if not self._frames:
            return {}
        return {
            camera: {name: value.tolist() for name, value in histograms.stats().items()}
            for camera, histograms in self._histograms.items()
        }


def _check_storable(info: Mapping[str, Any], columns: Mapping[str, Any]) -> None:
    """Raise unless a dataset's tables can hold the episode: one that they cannot would end the others with it."""
    texts = [sorted(set(values)) for values in columns.values() if isinstance(values, list)]
    try:
        json.dumps([info, texts], ensure_ascii=False).encode()
        np.array([info["seed"], info["variant"]], dtype=np.int64)
    except (UnicodeEncodeError, OverflowError) as error:
        raise MemobenchError(
            f"{info['task_name']!r}: a text that is no Unicode, or a number of more than 64 bits, cannot be stored "
            f"({error}); correct the task's texts or the seed"
        ) from None


def stage_demonstration(demo: Demonstration, folder: Path, formats: Collection[str] = (LEROBOT,)) -> StagedEpisode:
    """Write a demonstration that is in memory, images included, to ``folder``; the same one, if there, is kept."""
    with EpisodeStage(folder, formats) as stage:
        if demo.images is not None:
            for frame in range(len(demo)):
                stage.add_images({camera: demo.images[camera][frame] for camera in CAMERAS})
        return stage.publish(demo)


def stage_failure(info: dict[str, Any], reason: str, folder: Path) -> StagedEpisode:
    """Remember that a seed has no demonstration, so that a resumed run reports it as well."""
    record = {"failure": reason, "info": info, "language_persistent": [], "image_stats": {}}
    temporary = temporary_folder(folder)
    try:
        return _publish(temporary, folder, record)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _publish(temporary: Path, folder: Path, record: dict[str, Any]) -> StagedEpisode:
    """Add the record, bring everything to the disk, then give the folder its name."""
    record["files"] = {path.name: file_hash(path) for path in sorted(temporary.iterdir())}
    (temporary / RECORD_FILE).write_text(json.dumps(record))
    flush_to_disk([*temporary.iterdir(), temporary])
    try:
        temporary.rename(folder)
    except OSError:
        staged = read_staged(folder)  # another worker was first
        shutil.rmtree(temporary, ignore_errors=True)
        if staged is None or staged.info != record["info"]:
            raise MemobenchError(
                f"{folder} holds something else than the episode to be written there; delete it and run again"
            ) from None
        return staged
    flush_to_disk([folder.parent])
    return StagedEpisode(folder, record)
