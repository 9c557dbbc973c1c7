"""Stage episodes: keep finished ones on disk while a dataset is being made.

Each episode is one folder, complete or absent: it is written under a temporary name and renamed when every file has
reached the disk, so a run killed at any moment leaves finished episodes, and folders that are recognised as unfinished.
An episode's file names and bytes depend on the episode alone, never on the worker that made it.

::

    <staging>/episodes/000012/episode.json        identity, digest, statistics
                              arrays.npz          states, actions, proprio, label columns (no pickle)
                              image.mp4, wrist_image.mp4

Images are encoded frame by frame while the episode is being made, so a worker's memory does not grow with its length.
"""

from __future__ import annotations

import contextlib
import json
import secrets
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field

from lerobot_memobench.datasets.demonstration import Demonstration, LanguageRow, labels, persistent_rows
from lerobot_memobench.datasets.episodes import DemonstrationRecord, check_whole, read_manifest
from lerobot_memobench.datasets.layout import MANIFEST_FILE, STAGING, TOP_LEVEL, image_key, is_dataset
from lerobot_memobench.datasets.video import ImageHistograms, Stats, VideoWriter
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import flush_to_disk, refuse_links, remove_drafts, write_file
from lerobot_memobench.jobs.processes import locked
from lerobot_memobench.sim.convention import CONVENTIONS, UPRIGHT, in_convention
from lerobot_memobench.untrusted import read_json, refusing

TEMPORARY = ".tmp-"
EPISODE_FILE = "episode.json"
ARRAYS_FILE = "arrays.npz"
FINISHED_EARLY = "finished_early"  # key of a dataset's request: whether episodes of it were left out
ADVICE = "it is damaged; delete its folder and run the command again"


# --- a finished episode ---


class StagedEpisode(BaseModel):
    """``episode.json`` of a finished episode in ``folder``; arrays and videos are read on demand.

    ``info`` is the episode's record (`DemonstrationRecord`), its ``language`` and number of ``frames``; of a failed
    episode at least its task's name and seed.
    """

    failure: str | None  # why there is no demonstration of this seed
    info: dict[str, Any]
    language_persistent: list[LanguageRow]
    image_stats: dict[str, dict[str, Any]]  # name of a camera's video to the statistics of its pixels
    folder: Path = Field(Path(), exclude=True)

    @property
    def length(self) -> int:
        """Number of frames."""
        return int(self.info["frames"])

    def record(self, versions: dict[str, str] | None = None) -> DemonstrationRecord:
        """Return the record of a successful episode."""
        return DemonstrationRecord.model_validate(self.info | {"versions": versions})

    def video(self, camera: str) -> Path:
        """Return the path of a camera's video."""
        return self.folder / f"{camera}.mp4"

    def camera_stats(self) -> dict[str, Stats]:
        """Return the statistics of each camera's pixels by the name of its column."""
        return {
            image_key(camera): {name: np.array(value) for name, value in stats.items()}
            for camera, stats in self.image_stats.items()
        }

    def arrays(self) -> dict[str, NDArray]:
        """Read states, actions, proprio and label columns; text columns are arrays of str."""
        path = self.folder / ARRAYS_FILE
        damaged = refusing(lambda why: MemobenchError(f"{path} cannot be read ({why}); {ADVICE}"))
        with damaged, np.load(path, allow_pickle=False) as data:
            return dict(data)


def read_staged(folder: Path) -> StagedEpisode | None:
    """Return the finished episode in ``folder``, or None if there is none."""
    try:
        episode: StagedEpisode = read_json(folder / EPISODE_FILE, StagedEpisode, ADVICE)
    except FileNotFoundError:
        return None
    return episode.model_copy(update={"folder": folder})


class StagedJob:
    """A job that makes one episode in ``folder``; two workers may run the same job."""

    folder: Path

    def finished(self) -> bool:
        """Return whether ``folder`` holds the episode, or the reason of its failure."""
        return read_staged(self.folder) is not None

    def episode(self) -> StagedEpisode:
        """Return the episode of a finished job."""
        episode = read_staged(self.folder)
        if episode is None:
            raise MemobenchError(f"{self.folder} was removed during the run; run the command again")
        return episode

    def failure(self) -> str | None:
        """Return why a finished job has no episode, or None."""
        return self.episode().failure


# --- writing an episode ---


class EpisodeStage:
    """Write one episode to ``folder``, images frame by frame, everything else at the end; an equal one is kept.

    A context: an episode that was not published when it ends is removed. ``convention`` is that of the videos.
    """

    def __init__(self, folder: Path, convention: str = UPRIGHT) -> None:
        self._folder, self._convention = folder, convention
        # Two workers may make the same episode, so each has a name of its own. A killed worker's folder is removed with
        # the staging folder.
        self._temporary = folder.parent / f"{TEMPORARY}{folder.name}-{secrets.token_hex(4)}"
        self._temporary.mkdir(parents=True)
        names = CONVENTIONS[convention].values()
        self._videos = {name: VideoWriter(self._temporary / f"{name}.mp4") for name in names}
        self._histograms = {name: ImageHistograms() for name in names}
        self._frames = 0

    def __enter__(self) -> EpisodeStage:
        return self

    def __exit__(self, *_: object) -> None:
        for video in self._videos.values():
            with contextlib.suppress(Exception):  # on a full disk closing fails as well, and all files are deleted
                video.close(flush=False)
        shutil.rmtree(self._temporary, ignore_errors=True)

    def add_images(self, images: Mapping[str, NDArray[np.uint8]]) -> None:
        """Add the next frame of both cameras, (H, W, 3) uint8 each, upright."""
        self._frames += 1
        for name, image in in_convention(images, self._convention).items():
            self._videos[name].add(image)
            self._histograms[name].add(image)

    def publish(self, demo: Demonstration) -> StagedEpisode:
        """Write everything except the images, which were added before, and give the folder its name."""
        assert self._frames in (0, len(demo)), "add images of each frame, or of none"
        columns = labels(demo)
        record = DemonstrationRecord.of(demo).model_dump(exclude={"versions"})
        info = record | {"language": demo.task.language, "frames": len(demo)}
        for video in self._videos.values():
            video.close()
        stats = {
            camera: {name: value.tolist() for name, value in histograms.stats().items()}
            for camera, histograms in (self._histograms if self._frames else {}).items()
        }
        arrays: dict[str, Any] = {
            "states": demo.states,
            "actions": demo.actions,
            "proprio": demo.proprio,
            "objects": demo.objects,
            **({} if demo.executed is None else {"executed": demo.executed}),
            **columns,
        }
        np.savez_compressed(self._temporary / ARRAYS_FILE, **arrays)
        return self._publish(info, None, persistent_rows(columns), stats)

    def _publish(
        self, info: dict[str, Any], failure: str | None, rows: list[LanguageRow], image_stats: dict[str, Any]
    ) -> StagedEpisode:
        episode = StagedEpisode(
            failure=failure, info=info, language_persistent=rows, image_stats=image_stats, folder=self._folder
        )
        (self._temporary / EPISODE_FILE).write_text(episode.model_dump_json())
        flush_to_disk(*self._temporary.iterdir(), self._temporary)  # a complete folder never has incomplete files
        try:
            self._temporary.rename(self._folder)
        except OSError:
            staged = read_staged(self._folder)  # another worker was first
            if staged is None or staged.info != info:
                raise MemobenchError(f"{self._folder} holds another episode; delete it and run again") from None
            return staged
        flush_to_disk(self._folder.parent)
        return episode


def stage_demonstration(demo: Demonstration, folder: Path, convention: str = UPRIGHT) -> StagedEpisode:
    """Write a demonstration in memory, with its images, to ``folder``; an equal one that exists already is kept."""
    with EpisodeStage(folder, convention) as stage:
        images = demo.images or {}
        for frames in zip(*images.values(), strict=True):
            stage.add_images(dict(zip(images, frames, strict=True)))
        return stage.publish(demo)


def stage_failure(info: dict[str, Any], reason: str, folder: Path) -> StagedEpisode:
    """Store the reason why a seed has no demonstration, so that a resumed run reports it as well."""
    with EpisodeStage(folder) as stage:
        return stage._publish(info, reason, [], {})


# --- the run ---


def check_destination(out: Path) -> None:
    """Raise unless ``out`` is absent, empty, or holds only an unfinished run."""
    if is_dataset(out):
        raise MemobenchError(f"{out} already holds a finished dataset; name another folder or delete this one first")
    if ":" in str(out) and not out.is_absolute():
        raise MemobenchError(f"{out} contains a colon, which Arrow reads as an address; use an absolute path")
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file, expected a folder to write a dataset to; name another path")
    refuse_links(*(out / name for name in (STAGING, *TOP_LEVEL)))
    # Files of an interrupted move next to the staging folder are replaced.
    strangers = [p.name for p in out.iterdir() if p.name != STAGING] if out.is_dir() else []
    if strangers and not ((out / STAGING).is_dir() and set(strangers) <= set(TOP_LEVEL)):
        raise MemobenchError(
            f"{out} holds {', '.join(sorted(strangers)[:3])}, no part of a dataset being made; name an empty folder"
        )


@contextlib.contextmanager
def episodes_folder(out: Path, request: dict[str, Any]) -> Iterator[Path]:
    """Lock the destination ``out`` for a run with ``request``; yield the folder of its finished episodes.

    Episodes of an unfinished run of the same request are kept. Another request, and a run that goes on, are refused.
    """
    check_destination(out)
    staging = out / STAGING
    staging.mkdir(parents=True, exist_ok=True)
    with locked(staging, out):
        remove_drafts(staging)
        path = staging / "request.json"
        try:
            earlier = read_json(path, dict[str, Any], "delete its folder to start again")
        except FileNotFoundError:
            write_file(path, json.dumps(request, indent=1), durable=True)
        else:
            advice = f"delete {staging} to start again or name another folder"
            _compare_requests(earlier, request, f"{out} holds an unfinished run", advice)
        folder = staging / "episodes"
        folder.mkdir(exist_ok=True)
        yield folder.absolute()


def finished_manifest(out: Path, request: dict[str, Any]) -> dict[str, Any] | None:
    """Return the manifest of a finished dataset with this request, None if ``out`` holds no dataset.

    Raises:
        MemobenchError: the dataset is damaged, has another request, or another command made it.
    """
    if not is_dataset(out):
        return None
    manifest = read_manifest(out) if (out / MANIFEST_FILE).exists() else {}
    if "request" not in manifest:
        raise MemobenchError(f"{out} already holds a dataset that this command did not make; name another folder")
    # A finished dataset stays valid under newer versions.
    earlier = manifest["request"] | {key: value for key, value in request.items() if key == "versions"}
    _compare_requests(earlier, request, f"{out} already holds a finished dataset", "name another folder")
    check_whole(out)
    shutil.rmtree(out / STAGING, ignore_errors=True)  # a kill in the last moment may have left it
    return manifest


def _compare_requests(earlier: dict[str, Any], request: dict[str, Any], subject: str, advice: str) -> None:
    for key, value in {FINISHED_EARLY: False, **request}.items():  # only `generate --finish` writes this key
        before = {FINISHED_EARLY: False, **earlier}.get(key)
        if before != value:
            raise MemobenchError(f"{subject} with {key}={short(before)}, now {short(value)} was asked for; {advice}")
