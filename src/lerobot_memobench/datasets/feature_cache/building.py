"""Make a memory cache, or finish one."""

from __future__ import annotations

import contextlib
import logging
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from lerobot_memobench.datasets.feature_cache.decoding import FrameReader, frame_reader
from lerobot_memobench.datasets.feature_cache.encoding import Encoding, FrameEncoder, Progress
from lerobot_memobench.datasets.feature_cache.frame_table import FrameTable, read_frame_table
from lerobot_memobench.datasets.feature_cache.layout import (
    FOLDER,
    FORMAT,
    TOKENS_FILE,
    CacheMeta,
    dataset_fingerprint,
    readable_meta,
    slot_starts,
    texts_file,
)
from lerobot_memobench.datasets.feature_cache.room import reserve, telling_of_the_disk
from lerobot_memobench.datasets.feature_cache.tables import TextEncoder, add_embeddings, write_meta, write_tables
from lerobot_memobench.io import free_bytes, in_words, remove_drafts, write_file
from lerobot_memobench.jobs.processes import taking_turns
from lerobot_memobench.jobs.threads import cores

logger = logging.getLogger(__name__)

MOST_THREADS = 8


def _warn(folder: Path) -> None:
    logger.warning("Another process is making the memory cache %s; waiting for it to finish.", folder)


def build_memory_cache(
    root: Path,
    name: str,
    frames: FrameEncoder,
    texts: TextEncoder,
    *,
    camera: str = "observation.images.image",
    stride: int = 1,
    batch_size: int = 64,
    workers: int | None = None,
    progress: Progress | None = None,
    place: Path | None = None,
    read: FrameReader | None = None,
    tell: Callable[[str], None] = logger.info,
    wait: Callable[[Path], None] = _warn,
) -> Path:
    """Build, or finish building, the cache ``<root>/memory_cache/<name>``; a fitting complete one is left alone.

    A killed build goes on with the first episode it did not finish. A cache that does not fit is made again. A second
    builder (another rank) waits, and finds the work done. Room for the whole is taken on the disk before anything is
    encoded.

    Args:
        root: folder of a LeRobotDataset v3.0.
        frames: the frozen vision tower. texts: the frozen text encoder.
        camera: image column that memory shows. stride: every how many frames one is stored.
        batch_size: frames per pass of the tower.
        workers: threads that decode videos ahead of the tower; as many as there are cores, up to 8, by default.
        progress: called with (episodes done, episodes in all), first with what is done already.
        place: folder in which the cache's is made, where it is not to lie beside the dataset.
        read: from where frames come; from the camera's videos by default.
        tell: told what is made, and how large it will be, before it is made.
        wait: called with the cache's folder where another builder is at it, before that is waited for; it may raise
            instead. A warning by default.

    Returns:
        The cache's folder.

    Raises:
        MemobenchError: ``root`` is no dataset, or has no such camera; or the disk has no room, and then nothing of a
            cache that was begun is left, and of one that was gone on with the episodes that it had finished.
    """
    root = Path(root)
    fingerprint, table = dataset_fingerprint(root, camera), read_frame_table(root)
    meta = _describe(table, fingerprint, frames, texts, camera, stride)
    progress = progress or (lambda _done, _all: None)
    work = _Work(root, (place or root / FOLDER) / name, meta, table, texts, tell)
    if work.is_done:  # read without a lock: it may lie where nobody may write
        progress(table.num_episodes, table.num_episodes)
        return work.folder
    read = read or frame_reader(root, camera)
    with telling_of_the_disk(work.folder):
        work.folder.parent.mkdir(parents=True, exist_ok=True)
        if place is None:
            keep_from_the_hub(root)
        with taking_turns(work.folder.parent / f"{name}.lock", partial(wait, work.folder)):
            begun = work.begin()
            encoding = Encoding(work.folder, begun, table, batch_size, workers or min(cores(), MOST_THREADS))
            encoding.run(frames, read, progress)
            write_meta(work.folder, replace(begun, complete=True))
    return work.folder


def _describe(
    table: FrameTable, fingerprint: str, frames: FrameEncoder, texts: TextEncoder, camera: str, stride: int
) -> CacheMeta:
    """Return what an unfinished cache says of itself."""
    return CacheMeta(
        format=FORMAT,
        dataset=fingerprint,
        frames_key=frames.key,
        texts_key=texts.key,
        camera=camera,
        stride=stride,
        tokens_per_frame=frames.tokens_per_frame,
        dim=frames.dim,
        slots=int(slot_starts(table.episodes, stride)[-1]),
        levels=list(table.subgoals),
        oracle=table.memory is not None,
        complete=False,
    )


def keep_from_the_hub(root: Path) -> None:
    """Let no upload of the dataset's folder, LeRobot's `push_to_hub` among them, take its caches along.

    The hub's own way: it ignores what a ``.gitignore`` at the top of what is uploaded names.
    """
    path, line = root / ".gitignore", f"/{FOLDER}/"
    with contextlib.suppress(OSError):  # the caches may lie behind a link in a folder that takes nothing
        there = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        if line not in there:
            write_file(path, "\n".join([*there, line]) + "\n")


@dataclass(frozen=True)
class _Work:
    """A cache that is wanted, and what is there of it."""

    root: Path
    folder: Path
    meta: CacheMeta
    table: FrameTable
    texts: TextEncoder
    tell: Callable[[str], None]

    @property
    def fitting(self) -> CacheMeta | None:
        """What is there and fits, complete or not; begun with another text encoder perhaps."""
        there = readable_meta(self.root, self.folder.name, self.folder.parent)
        if there is None or replace(there, complete=False, texts_key=self.meta.texts_key) != self.meta:
            return None
        return there

    @property
    def is_done(self) -> bool:
        """Whether nothing is left to do."""
        there = self.fitting
        if there is None or not there.complete:
            return False
        return (self.folder / texts_file(there.texts_key, self.texts.key)).is_file()

    def begin(self) -> CacheMeta:
        """Make everything but the tokens, for which room is taken; return what is there now."""
        there = self.fitting
        if there is None:
            self._make_room()
            there = self._begin_anew()
        else:
            remove_drafts(self.folder)
            reserve(self.folder / TOKENS_FILE, self.meta.bytes)
            add_embeddings(self.folder, there, self.texts)
        return there

    def _make_room(self) -> None:
        """Say what will be made, and take away what lies in its place."""
        if self.folder.exists():
            self.tell(
                f"The memory cache {self.folder} cannot be used (its dataset has changed since, or an earlier version "
                "made it): it is made again."
            )
            shutil.rmtree(self.folder)
        self.tell(
            f"The memory cache {self.folder} takes {in_words(self.meta.bytes)}: {self.meta.slots:,} frames of "
            f"{in_words(self.meta.frame_bytes)}; {in_words(free_bytes(self.folder))} are free there."
        )

    def _begin_anew(self) -> CacheMeta:
        """Begin a cache; nothing of it is left where that fails."""
        self.folder.mkdir()
        try:
            reserve(self.folder / TOKENS_FILE, self.meta.bytes)
            write_tables(self.folder, self.table, self.texts)
            write_meta(self.folder, self.meta)
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise
        return self.meta
