"""Stage episodes: keep finished ones on disk while a dataset is being made.

Each episode is one folder, complete or absent: it is written under a temporary name and renamed when every file has
reached the disk, so a run killed at any moment leaves finished episodes and rubbish with a name of its own. An
episode's file names and bytes depend on the episode alone, never on the worker that made it.

::

    <staging>/episodes/000012/episode.json        identity, digest, statistics, hash of each file
                              arrays.npz          states, actions, proprio, label columns (no pickle)
                              image.mp4, wrist_image.mp4

Frames go to the encoder while the episode is being made, so a worker's memory does not grow with its length.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray
from pydantic import BaseModel, model_validator

from lerobot_memobench.datasets.demonstration import Demonstration, LanguageRow, digest, labels, persistent_rows
from lerobot_memobench.datasets.lerobot_format.layout import STAGING
from lerobot_memobench.datasets.lerobot_format.record import EpisodeRecord
from lerobot_memobench.datasets.video import ImageHistograms, Stats, VideoWriter
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    Count,
    Number,
    Whole,
    checked,
    file_hash,
    file_name,
    read_json,
    remove_drafts,
    short,
    write_file,
)
from lerobot_memobench.jobs.processes import HeldError, locked
from lerobot_memobench.protocol import CAMERAS
from lerobot_memobench.tasks.task import MEMOBENCH

TEMPORARY = ".tmp-"
REQUEST_FILE = "request.json"
FINISHED_EARLY = "finished_early"
"""Key of a dataset's request: whether episodes of it were left out."""
UNASKED: dict[str, Any] = {
    "formats": ["lerobot"],
    "policy": None,
    "perturb": False,
    "prompted_episodes": None,
    FINISHED_EARLY: False,
    "world": MEMOBENCH,
}
"""Values of the keys that requests of earlier or later versions may lack."""
RECORD_FILE = "episode.json"
ARRAYS_FILE = "arrays.npz"
ADVICE = "it is damaged; delete the folder that it is in and run the command again"


# --- a finished episode ---


Frames = Annotated[list[Count], Len(1, 1)]
"""Over how many frames a statistic is, (1,)."""
Pixels = Annotated[list[Annotated[list[Annotated[list[Number], Len(1, 1)]], Len(1, 1)]], Len(3, 3)]
"""A statistic of a camera's channels, (3, 1, 1)."""


class Identity(BaseModel):
    """Fields of an episode that could not be made."""

    task_name: str
    seed: Whole


class Info(EpisodeRecord):
    """Fields of an episode for meta/episodes, manifest and card (see ``episode_info``)."""

    language: str
    frames: Count


class Row(BaseModel, extra="allow"):
    """One of LeRobot's persistent language rows; `persistent_rows` writes them."""

    role: str | None = None
    content: str | None = None
    style: str | None = None
    timestamp: Number | None = None


class Record(BaseModel):
    """``episode.json``.

    Attributes:
        failure: why there is no demonstration of this seed, or None.
        info: of `Info`, or where it failed of `Identity`, and maybe more.
        language_persistent: LeRobot's persistent language rows (see ``persistent_rows``).
        image_stats: camera to the statistics of its pixels (see ``ImageHistograms``).
        files: name to sha256 of the other files.
    """

    failure: str | None
    info: dict[str, Any]
    language_persistent: list[Row]
    image_stats: dict[str, dict[str, Pixels | Frames]]
    files: dict[str, str]

    @model_validator(mode="after")
    def _check_info(self) -> Record:
        checked(self.info, Info if self.failure is None else Identity)
        return self


@dataclass(frozen=True)
class StagedEpisode:
    """A finished episode's folder; ``record`` is its episode.json, the rest is read when asked for."""

    folder: Path
    record: Record

    @property
    def failure(self) -> str | None:
        """Why there is no demonstration of this seed, or None."""
        return self.record.failure

    @property
    def info(self) -> dict[str, Any]:
        """Identity and per-episode metadata (see ``episode_info``)."""
        return self.record.info

    @property
    def language_rows(self) -> list[LanguageRow]:
        """LeRobot's persistent language rows (see ``persistent_rows``)."""
        return [row.model_dump(exclude_unset=True) for row in self.record.language_persistent]

    @property
    def has_images(self) -> bool:
        """Whether its cameras were recorded."""
        return bool(self.record.image_stats)

    def video(self, camera: str) -> Path:
        """Return the file of a camera's video."""
        return self.folder / f"{camera}.mp4"

    def image_stats(self, camera: str) -> Stats:
        """Return the statistics of a camera's pixels (see ``ImageHistograms``)."""
        return {name: np.array(value) for name, value in self.record.image_stats[camera].items()}

    def arrays(self) -> dict[str, NDArray]:
        """Read states, actions, proprio and label columns; text columns are arrays of str."""
        with np.load(self.folder / ARRAYS_FILE, allow_pickle=False) as data:
            return dict(data)

    def check(self) -> None:
        """Raise a MemobenchError that names the first file with other bytes than those that were written."""
        for name, expected in self.record.files.items():
            path = self.folder / file_name(name, f"a file that {self.folder / RECORD_FILE} names")
            found = file_hash(path) if path.is_file() else "missing"
            if found != expected:
                raise MemobenchError(
                    f"{path} is damaged (sha256 {found[:12]}, written as {expected[:12]}); "
                    f"delete the folder {self.folder} and generate again to make this episode again"
                )


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the finished episode in ``folder``, or None when there is none."""
    try:
        return StagedEpisode(folder, read_json(folder / RECORD_FILE, Record, ADVICE))
    except FileNotFoundError:
        return None


class StagedJob:
    """A job that makes one episode, complete or absent: two workers at the same one do no harm."""

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


# --- writing one ---


class EpisodeStage:
    """An episode on its way to the disk: images frame by frame, everything else at the end.

    A context: whatever was not published when it ends leaves nothing behind.

    Args:
        folder: where the finished episode goes; the same one, if there, is kept.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._temporary = temporary_folder(folder)
        self._videos = {camera: VideoWriter(self._temporary / f"{camera}.mp4") for camera in CAMERAS}
        self._histograms = {camera: ImageHistograms() for camera in CAMERAS}
        self._frames = 0

    def __enter__(self) -> EpisodeStage:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for video in self._videos.values():
            with contextlib.suppress(Exception):  # on a full disk closing fails as well, and all of it is deleted
                video.abandon()
        shutil.rmtree(self._temporary, ignore_errors=True)

    def add_images(self, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Take both cameras' next frame, (H, W, 3) uint8 each."""
        self._frames += 1
        for camera, video in self._videos.items():
            video.add(images[camera])
            self._histograms[camera].add(images[camera])

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
        for video in self._videos.values():
            video.close()
        shown = self._histograms if self._frames else {}
        stats = {
            camera: {name: value.tolist() for name, value in histograms.stats().items()}
            for camera, histograms in shown.items()
        }
        columns: dict[str, Any] = {
            "states": demo.states,
            "actions": demo.actions,
            "proprio": demo.proprio,
            "objects": demo.objects,
            **({} if demo.executed is None else {"executed": demo.executed}),
            **found.columns(),
        }
        np.savez_compressed(self._temporary / ARRAYS_FILE, **columns)
        return _publish(self._temporary, self._folder, None, info, persistent_rows(found), stats)


def episode_info(demo: Demonstration) -> dict[str, Any]:
    """Return the fields of an episode for meta/episodes, manifest and card."""
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
        **({} if demo.task.world == MEMOBENCH else {"world": demo.task.world, "stand_ins": list(demo.stand_ins)}),
        "fixture_poses": {name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
        "digest": digest(demo),
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


def stage_demonstration(demo: Demonstration, folder: Path) -> StagedEpisode:
    """Write a demonstration that is in memory, images included, to ``folder``; the same one, if there, is kept."""
    with EpisodeStage(folder) as stage:
        if demo.images is not None:
            for frame in range(len(demo)):
                stage.add_images({camera: demo.images[camera][frame] for camera in CAMERAS})
        return stage.publish(demo)


def stage_failure(info: dict[str, Any], reason: str, folder: Path) -> StagedEpisode:
    """Keep the reason why a seed has no demonstration, so that a resumed run reports it as well."""
    temporary = temporary_folder(folder)
    try:
        return _publish(temporary, folder, reason, info, [], {})
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _publish(
    temporary: Path,
    folder: Path,
    failure: str | None,
    info: dict[str, Any],
    language_rows: list[LanguageRow],
    image_stats: dict[str, Any],
) -> StagedEpisode:
    """Add the record, bring everything to the disk, then give the folder its name."""
    files = {path.name: file_hash(path) for path in sorted(temporary.iterdir())}
    record = Record(
        failure=failure,
        info=info,
        language_persistent=[Row(**row) for row in language_rows],
        image_stats=image_stats,
        files=files,
    )
    (temporary / RECORD_FILE).write_text(record.model_dump_json(exclude_unset=True))
    flush_to_disk([*temporary.iterdir(), temporary])
    try:
        temporary.rename(folder)
    except OSError:
        staged = read_staged(folder)  # another worker was first
        shutil.rmtree(temporary, ignore_errors=True)
        if staged is None or staged.info != info:
            raise MemobenchError(
                f"{folder} holds something else than the episode to be written there; delete it and run again"
            ) from None
        return staged
    flush_to_disk([folder.parent])
    return StagedEpisode(folder, record)


def temporary_folder(folder: Path) -> Path:
    """Make and return an empty folder, to be renamed to ``folder`` when it is whole."""
    temporary = folder.parent / f"{TEMPORARY}{_host()}-{os.getpid()}-{folder.name}"
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    return temporary


def flush_to_disk(paths: Iterable[Path]) -> None:
    """Wait until the disk holds files, or the entries of folders."""
    for path in paths:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


# --- the run that they belong to ---


@contextlib.contextmanager
def episodes_folder(out: Path, request: dict[str, Any]) -> Iterator[Path]:
    """Hold the destination ``out`` for a run that answers ``request``; yield the folder for its finished episodes.

    Those of an unfinished run of the same request are there already.

    Raises:
        MemobenchError: another run is writing there, or an unfinished one answers another request.
    """
    staging = out / STAGING
    staging.mkdir(parents=True, exist_ok=True)
    with locked(staging, out):
        remove_drafts(staging)
        asked = staging / REQUEST_FILE
        try:
            earlier = read_json(asked, dict[str, Any], "delete the folder that it is in to start again")
        except FileNotFoundError:
            write_file(asked, json.dumps(request, indent=1), durable=True)
        else:
            advice = f"delete {staging} to start again or name another folder"
            compare_requests(earlier, request, f"{out} holds an unfinished run", advice)
        folder = staging / "episodes"
        folder.mkdir(exist_ok=True)
        clean_temporaries(folder)
        yield folder.absolute()


def remove_staging(out: Path) -> None:
    """Remove the staging folder of a finished run, unless a run is at work there."""
    staging = out / STAGING
    with contextlib.suppress(FileNotFoundError, HeldError), locked(staging, out):
        shutil.rmtree(staging, ignore_errors=True)


def compare_requests(earlier: dict[str, Any], request: dict[str, Any], what: str, advice: str) -> None:
    """Raise with the first thing that was asked for differently."""
    for key, value in {**UNASKED, **request}.items():
        there = {**UNASKED, **earlier}.get(key)
        if there != value:
            raise MemobenchError(f"{what} with {key}={short(there)}, now {short(value)} was asked for; {advice}")


def clean_temporaries(folder: Path) -> None:
    """Remove what this machine's killed workers left in the folder of episodes; others may still be working."""
    for path in folder.glob(f"{TEMPORARY}{_host()}-*"):
        pid = path.name.removeprefix(f"{TEMPORARY}{_host()}-").split("-")[0]
        if not (pid.isdigit() and _alive(int(pid))):
            shutil.rmtree(path, ignore_errors=True)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return pid != os.getpid()  # what this process left behind earlier is rubbish too


def _host() -> str:
    return re.sub(r"[^A-Za-z0-9]", "_", socket.gethostname())
