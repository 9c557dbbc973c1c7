"""Finished episodes on disk while a dataset is being made.

Each episode is one folder, complete or absent: it is written under a temporary name and renamed when every
file has reached the disk, so a run killed at any moment leaves finished episodes and rubbish with a name of
its own. An episode's file names and bytes depend on the episode alone, never on the worker that made it.

::

    <staging>/episodes/000012/episode.json        identity, digest, statistics, hash of each file
                              arrays.npz          states, actions, proprio, label columns (no pickle)
                              image.mp4, wrist_image.mp4
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import CAMERAS, Demonstration, digest, labels
from lerobot_memobench.datasets.language import LanguageRow, persistent_rows
from lerobot_memobench.datasets.video import Stats, encode_video, image_stats
from lerobot_memobench.errors import MemobenchError

RECORD_FILE = "episode.json"
ARRAYS_FILE = "arrays.npz"
TEMPORARY = ".tmp-"


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


def stage_demonstration(demo: Demonstration, folder: Path) -> StagedEpisode:
    """Write a demonstration, images as video, to ``folder``; the same one, if there, is kept."""
    found = labels(demo)
    columns: dict[str, Any] = {"states": demo.states, "actions": demo.actions, "proprio": demo.proprio}
    columns |= {name: np.asarray(column) for name, column in found.columns().items()}
    temporary = _temporary(folder)
    np.savez_compressed(temporary / ARRAYS_FILE, **columns)
    stats: dict[str, Any] = {}
    if demo.images is not None:
        for camera in CAMERAS:
            encode_video(demo.images[camera], temporary / f"{camera}.mp4")
            stats[camera] = {name: value.tolist() for name, value in image_stats(demo.images[camera]).items()}
    record = {
        "failure": None,
        "info": episode_info(demo),
        "language_persistent": persistent_rows(found),
        "image_stats": stats,
    }
    return _publish(temporary, folder, record)


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


def clean_temporaries(folder: Path) -> None:
    """Remove what killed workers left in the folder of episodes."""
    for path in folder.glob(f"{TEMPORARY}*"):
        shutil.rmtree(path, ignore_errors=True)


def file_hash(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def write_json(value: Any, path: Path) -> None:
    """Write JSON so that ``path`` holds either its old content or all of the new one."""
    temporary = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
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
    temporary = folder.parent / f"{TEMPORARY}{os.getpid()}-{folder.name}"
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
