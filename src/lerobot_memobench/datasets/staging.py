"""Finished episodes on disk while a dataset is being made.

Each episode is one folder, complete or absent: it is written under a temporary name and renamed when every
file has reached the disk, so a run killed at any moment leaves finished episodes and rubbish with a name of
its own. An episode's file names and bytes depend on the episode alone, never on the worker that made it.

::

    <staging>/episodes/000012/episode.json        identity, digest, statistics, hash of each file
                              arrays.npz          states, actions, proprio, label columns (no pickle)
                              image.mp4, wrist_image.mp4
                              demonstration.hdf5  in the published layout, when that was asked for

Frames go to the encoder while the episode is being made, so a worker's memory does not grow with its length.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import socket
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import CAMERAS, Demonstration, digest, labels
from lerobot_memobench.datasets.hdf5 import EpisodeFile, data_attributes
from lerobot_memobench.datasets.language import LanguageRow, persistent_rows
from lerobot_memobench.datasets.video import ImageHistograms, Stats, VideoWriter
from lerobot_memobench.errors import MemobenchError

RECORD_FILE = "episode.json"
ARRAYS_FILE = "arrays.npz"
HDF5_FILE = "demonstration.hdf5"
TEMPORARY = ".tmp-"

LEROBOT, HDF5 = "lerobot", "hdf5"
FORMATS = (LEROBOT, HDF5)
"""What a run can make of its episodes."""


@dataclass(frozen=True)
class StagedEpisode:
    """A finished episode's folder; ``record`` is its episode.json, the rest is read when asked for."""

    folder: Path
    record: dict[str, Any]

    @property
    def failure(self) -> str | None:
        """Why there is no demonstration of this seed, or None."""
        return self.record["failure"]

    @property
    def info(self) -> dict[str, Any]:
        """Identity and per-episode metadata (see ``episode_info``)."""
        return self.record["info"]

    @property
    def language_rows(self) -> list[LanguageRow]:
        return self.record["language_persistent"]

    @property
    def has_images(self) -> bool:
        return bool(self.record["image_stats"])

    @property
    def hdf5(self) -> Path:
        """The demonstration in the published layout, alone at the root of a file of its own."""
        return self.folder / HDF5_FILE

    @property
    def hdf5_attributes(self) -> dict[str, Any] | None:
        """Attributes of its task's HDF5 file; None where HDF5 was not asked for."""
        return self.record.get("hdf5")

    @property
    def video_bytes(self) -> int:
        """Size of its videos."""
        return sum(self.video(camera).stat().st_size for camera in self.record["image_stats"])

    def video(self, camera: str) -> Path:
        return self.folder / f"{camera}.mp4"

    def image_stats(self, camera: str) -> Stats:
        return {name: np.array(value) for name, value in self.record["image_stats"][camera].items()}

    def arrays(self) -> dict[str, NDArray]:
        """Read states, actions, proprio and label columns; text columns are arrays of str."""
        with np.load(self.folder / ARRAYS_FILE, allow_pickle=False) as data:
            return dict(data)

    def check(self) -> None:
        """Raise a MemobenchError that names the first file whose bytes are not those that were written."""
        for name, expected in self.record["files"].items():
            path = self.folder / name
            found = file_hash(path) if path.is_file() else "missing"
            if found != expected:
                raise MemobenchError(
                    f"{path} is damaged (sha256 {found[:12]}, written as {expected[:12]}); "
                    f"delete the folder {self.folder} and generate again to make this episode anew"
                )


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
        self._temporary = _temporary(folder)
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
        for video in self._videos.values():
            video.abandon()
        if self._hdf5 is not None:
            self._hdf5.abandon()
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
        stats: dict[str, Any] = {}
        if LEROBOT in self._formats:
            columns: dict[str, Any] = {"states": demo.states, "actions": demo.actions, "proprio": demo.proprio}
            columns |= {name: np.asarray(column) for name, column in found.columns().items()}
            np.savez_compressed(self._temporary / ARRAYS_FILE, **columns)
            for camera, video in self._videos.items():
                video.close()
                if self._frames:
                    found_stats = self._histograms[camera].stats()
                    stats[camera] = {name: value.tolist() for name, value in found_stats.items()}
        record = {
            "failure": None,
            "info": episode_info(demo),
            "language_persistent": persistent_rows(found),
            "image_stats": stats,
        }
        if self._hdf5 is not None:
            self._hdf5.finish(demo)
            record["hdf5"] = data_attributes(demo.task)
        return _publish(self._temporary, self._folder, record)


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
    return _publish(_temporary(folder), folder, record)


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the finished episode in ``folder``, or None when there is none."""
    try:
        return StagedEpisode(folder, json.loads((folder / RECORD_FILE).read_text()))
    except FileNotFoundError:
        return None
    except json.JSONDecodeError as error:
        raise MemobenchError(
            f"{folder / RECORD_FILE} is damaged ({error}); delete the folder and generate again"
        ) from None


class StagedJob:
    """What jobs have in common that make one episode, complete or absent: two workers at the same one do no harm."""

    folder: Path

    def finished(self) -> bool:
        """Whether the episode, or why there is none, is in ``folder``."""
        return read_staged(self.folder) is not None

    def failure(self) -> str | None:
        """Why a finished job has no episode, or None."""
        return staged(self).failure


def staged(job: StagedJob) -> StagedEpisode:
    """Return the finished episode of a job that has been run."""
    found = read_staged(job.folder)
    if found is None:
        raise MemobenchError(f"{job.folder} has vanished while the run was going on; run the command again")
    return found


def clean_temporaries(folder: Path) -> None:
    """Remove what this machine's killed workers left in the folder of episodes; others may still be working."""
    for path in folder.glob(f"{TEMPORARY}{_host()}-*"):
        pid = path.name.removeprefix(f"{TEMPORARY}{_host()}-").split("-")[0]
        if not (pid.isdigit() and _alive(int(pid))):
            shutil.rmtree(path, ignore_errors=True)


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return pid != os.getpid()  # what this process left behind earlier is rubbish too


def file_hash(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(value: Any, path: Path) -> None:
    """Write JSON so that ``path`` holds either its old content or all of the new one."""
    temporary = path.with_name(f"{TEMPORARY}{_host()}-{os.getpid()}-{path.name}")
    temporary.write_text(json.dumps(value, indent=1))
    flush_to_disk([temporary])
    temporary.replace(path)


def flush_to_disk(paths: Iterable[Path]) -> None:
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _temporary(folder: Path) -> Path:
    temporary = folder.parent / f"{TEMPORARY}{_host()}-{os.getpid()}-{folder.name}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    return temporary


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
