"""Make a feature cache, or finish one."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frames import (
    FrameReader,
    FrameTable,
    TextEncoder,
    frame_reader,
    numbered,
    numbered_memory,
    read_frame_table,
)
from lerobot_memobench.datasets.feature_cache.layout import (
    DONE_FILE,
    FOLDER,
    FORMAT,
    HASHES_FILE,
    META_FILE,
    TEXTS_FILE,
    TOKENS_FILE,
    CacheMeta,
    dataset_fingerprint,
    readable_meta,
    slot_starts,
    texts_file,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import FULL, draft_of, file_hash, free_bytes, in_words, read_json, remove_drafts, write_file
from lerobot_memobench.jobs.processes import taking_turns
from lerobot_memobench.jobs.threads import cores

logger = logging.getLogger(__name__)
MOST_THREADS = 8
_CLOSED = (errno.EACCES, errno.EPERM, errno.EROFS)
_ELSEWHERE = "put it elsewhere (`memobench cache --out`, --policy.feature_cache_dir)"
Progress = Callable[[int, int], None]
"""Called as progress(episodes done, episodes in all)."""


class FrameEncoder(Protocol):
    """The frozen visual encoder: images (N, 3, H, W) in [0, 1], or what else is read -> tokens (N, P, D) bfloat16."""

    @property
    def tokens_per_frame(self) -> int:
        """P."""

    @property
    def dim(self) -> int:
        """D."""

    @property
    def key(self) -> str:
        """Identity of the encoder: weights and input size."""

    def __call__(self, images: Any, /) -> Tensor:
        """Encode."""


def _warn(folder: Path) -> None:
    logger.warning("Another process is making the feature cache %s; waiting for it to finish.", folder)


def build_feature_cache(
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
    """Build, or finish building, the cache ``<root>/feature_cache/<name>``; a fitting complete one is left alone.

    A killed build goes on with the first episode it did not finish. A cache that does not fit is made again. A second
    builder (another rank) waits, and finds the work done. Room for the whole is taken on the disk before anything is
    encoded.

    Args:
        root: folder of a LeRobotDataset v3.0.
        frames: the frozen visual encoder. texts: the frozen text encoder.
        camera: image column that memory shows. stride: every how many frames one is stored.
        batch_size: frames per pass of the encoder.
        workers: threads that decode videos ahead of the encoder; as many as there are cores, up to 8, by default.
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
    wanted = CacheMeta(
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
    progress = progress or (lambda _done, _all: None)
    folder = (place or root / FOLDER) / name
    there = _fitting(root, folder, wanted)  # read without a lock: it may lie where nobody may write
    if there is not None and there.complete and (folder / texts_file(there.texts_key, texts.key)).is_file():
        progress(table.num_episodes, table.num_episodes)
        return folder
    read = read or frame_reader(root, camera)
    with telling_of_the_disk(folder):
        folder.parent.mkdir(parents=True, exist_ok=True)
        if place is None:
            keep_from_the_hub(root)
        with taking_turns(folder.parent / f"{name}.lock", partial(wait, folder)):
            begun = _fitting(root, folder, wanted)
            if begun is None:
                _begin(folder, wanted, table, texts, tell)
                begun = wanted
            else:
                remove_drafts(folder)
                reserve(folder / TOKENS_FILE, wanted.bytes)
                _add_embeddings(folder, begun, texts)
            _encode(folder, begun, table, frames, read, batch_size, workers or min(cores(), MOST_THREADS), progress)
            _write_hashes(folder, replace(begun, complete=True), kept=begun.complete)
            _write_meta(folder, replace(begun, complete=True))
    return folder


def keep_from_the_hub(root: Path) -> None:
    """Let no upload of the dataset's folder, LeRobot's `push_to_hub` among them, take its caches along.

    The hub's own way: it ignores what a ``.gitignore`` at the top of what is uploaded names.
    """
    path, line = root / ".gitignore", f"/{FOLDER}/"
    with contextlib.suppress(OSError):  # the caches may lie behind a link in a folder that takes nothing
        there = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
        if line not in there:
            write_file(path, "\n".join([*there, line]) + "\n")


def _fitting(root: Path, folder: Path, wanted: CacheMeta) -> CacheMeta | None:
    """Return what is there and fits, complete or not; begun with another text encoder perhaps."""
    there = readable_meta(root, folder.name, folder.parent)
    if there is None or replace(there, complete=False, texts_key=wanted.texts_key) != wanted:
        return None
    return there


def _begin(folder: Path, meta: CacheMeta, table: FrameTable, texts: TextEncoder, tell: Callable[[str], None]) -> None:
    """Begin a cache in the place of what lies there: its room and its tables; nothing is left where that fails."""
    if folder.exists():
        tell(
            f"The feature cache {folder} cannot be used (its dataset has changed since, or an earlier version made "
            "it): it is made again."
        )
        shutil.rmtree(folder)
    tell(
        f"The feature cache {folder} takes {in_words(meta.bytes)}: {meta.slots:,} frames of "
        f"{in_words(meta.frame_bytes)}; {in_words(free_bytes(folder))} are free there."
    )
    folder.mkdir()
    try:
        reserve(folder / TOKENS_FILE, meta.bytes)
        _write_tables(folder, table, texts)
        _write_meta(folder, meta)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


# --- tokens ---


def _encode(
    folder: Path,
    meta: CacheMeta,
    table: FrameTable,
    frames: FrameEncoder,
    read: FrameReader,
    batch_size: int,
    workers: int,
    progress: Progress,
) -> None:
    """Encode every episode that is not marked done; its mark is written after its tokens are on the disk.

    Videos are decoded in threads, a few parts ahead; the encoder takes them in their order, so that the file is
    the same whatever the number of threads, and a killed build has finished the first so many episodes. Tokens
    are written, not mapped: a disk that refuses a mapped page kills the process (SIGBUS).
    """
    done = _read_done(folder, table.num_episodes)
    progress(int(done.sum()), len(done))
    with (
        (folder / TOKENS_FILE).open("r+b") as file,
        ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool,
    ):
        parts = _parts(table, meta.stride, batch_size, np.flatnonzero(done == 0).tolist())
        for part, images in _ahead(pool, 2 * workers, parts, lambda part: read(part.episode, part.frames)):
            encoded = frames(images).to("cpu", torch.bfloat16).contiguous()
            file.seek(part.slot * meta.frame_bytes)
            file.write(encoded.view(torch.uint16).numpy().tobytes())
            if part.last:
                file.flush()
                os.fsync(file.fileno())
                done[part.episode] = 1
                _write_done(folder, done)
                progress(int(done.sum()), len(done))


@dataclass(frozen=True)
class _Part:
    """Frames of one episode that the encoder takes at once."""

    episode: int
    frames: list[int]
    slot: int  # where the first one's tokens go
    last: bool  # of its episode


def _parts(table: FrameTable, stride: int, batch_size: int, episodes: Sequence[int]) -> Iterator[_Part]:
    slots, lengths = slot_starts(table.episodes, stride), np.diff(table.episodes)
    for episode in episodes:
        wanted = list(range(0, int(lengths[episode]), stride))
        for first in range(0, len(wanted), batch_size):
            end = first + batch_size
            yield _Part(episode, wanted[first:end], int(slots[episode]) + first, end >= len(wanted))


def _ahead[Item, Result](
    pool: ThreadPoolExecutor, number: int, items: Iterator[Item], work: Callable[[Item], Result]
) -> Iterator[tuple[Item, Result]]:
    """Yield (item, work(item)) in order, with at most ``number`` items begun before they are asked for."""
    waiting: deque[tuple[Item, Future[Result]]] = deque()
    try:
        for item in items:
            waiting.append((item, pool.submit(work, item)))
            if len(waiting) >= number:
                oldest, future = waiting.popleft()
                yield oldest, future.result()
        while waiting:
            oldest, future = waiting.popleft()
            yield oldest, future.result()
    finally:
        for _, future in waiting:
            future.cancel()


# --- tables ---


def _write_tables(folder: Path, table: FrameTable, texts: TextEncoder) -> None:
    _write_done(folder, np.zeros(table.num_episodes, dtype=np.uint8))
    _save_array(folder / "episodes.npy", table.episodes)
    _save_array(folder / "phase.npy", table.phase)
    unique, subgoals = numbered(table)
    for level, rows in subgoals.items():
        _save_array(folder / f"subgoal-{level}.npy", rows)
    _write_json(folder / TEXTS_FILE, unique)
    _save_embeddings(folder / texts_file(texts.key, texts.key), unique, texts)
    if table.memory is not None:
        memories, rows = numbered_memory(table.memory)
        _save_array(folder / "memory.npy", rows)
        _write_json(folder / "memory.json", memories)


def _add_embeddings(folder: Path, meta: CacheMeta, texts: TextEncoder) -> None:
    """Write what another text encoder makes of the texts beside what the cache has; nothing if it is there."""
    path = folder / texts_file(meta.texts_key, texts.key)
    if not path.is_file():
        unique = read_json(folder / TEXTS_FILE, list[str], f"delete {folder}, and it is made again")
        _save_embeddings(path, unique, texts)


def _read_done(folder: Path, episodes: int) -> np.ndarray:
    """Return which episodes (E,) are done, uint8; none, where the file is damaged or gone."""
    try:
        done = np.load(folder / DONE_FILE)
    except Exception:  # NumPy answers damaged arrays with errors of every type
        done = None
    whole = isinstance(done, np.ndarray) and done.dtype == np.uint8 and done.shape == (episodes,)
    return done if whole and (done <= 1).all() else np.zeros(episodes, dtype=np.uint8)


def _write_done(folder: Path, done: np.ndarray) -> None:
    _save_array(folder / DONE_FILE, done, durable=True)  # as their tokens are


def _write_meta(folder: Path, meta: CacheMeta) -> None:
    write_file(folder / META_FILE, _meta_text(meta))


def _meta_text(meta: CacheMeta) -> str:
    return json.dumps(asdict(meta), indent=1)


def _write_hashes(folder: Path, meta: CacheMeta, *, kept: bool) -> None:
    """Write the hash of every file of a complete cache; those there are ``kept`` where only texts came since."""
    path = folder / HASHES_FILE
    earlier: dict[str, str] = {}
    with contextlib.suppress(FileNotFoundError):
        earlier = read_json(path, dict[str, str], f"delete {folder}, and it is made again") if kept else {}
    names = {file.name for file in folder.iterdir() if file.name not in (META_FILE, HASHES_FILE)}
    hashes = {name: earlier.get(name) or file_hash(folder / name) for name in sorted(names)}
    _write_json(path, hashes | {META_FILE: hashlib.sha256(_meta_text(meta).encode()).hexdigest()})


def _save_embeddings(path: Path, unique: list[str], texts: TextEncoder) -> None:
    _save_array(path, texts(unique).to(torch.float32).numpy() if unique else np.zeros((0, texts.dim), np.float32))


def _write_json(path: Path, value: Any) -> None:
    write_file(path, json.dumps(value, indent=1))


def _save_array(path: Path, array: np.ndarray, *, durable: bool = False) -> None:
    with draft_of(path, durable=durable) as draft:
        np.save(draft, array)


# --- room on the disk ---


def reserve(path: Path, size: int) -> None:
    """Make ``path`` a file of ``size`` bytes that the disk has room for; what it holds already stays.

    A file with holes would take no room until it is written to, and a full disk would end the build hours later.

    Raises:
        MemobenchError: the disk has no room. Nothing is changed then.
    """
    path.touch()
    missing = size - path.stat().st_blocks * 512
    if missing <= 0:
        return
    free = free_bytes(path.parent)
    if free < missing:
        raise no_room(path.parent, f"{in_words(missing)} are needed there and {in_words(free)} are free")
    with path.open("r+b") as file:
        if hasattr(os, "posix_fallocate"):
            os.posix_fallocate(file.fileno(), 0, size)
        else:  # macOS
            file.truncate(size)


def require_room(place: Path, folders: Mapping[Path, int]) -> None:
    """Refuse caches in ``place``, folder -> bytes of its tokens, if the disk lacks room for all that are not begun.

    Raises:
        MemobenchError: it does. Nothing is changed then.
    """
    missing = sum(size for folder, size in folders.items() if not (folder / TOKENS_FILE).is_file())
    free = free_bytes(place)
    if free < missing:
        raise no_room(place, f"{in_words(missing)} are needed there and {in_words(free)} are free")


def no_room(folder: Path, found: str) -> MemobenchError:
    """Return the error of a disk that is full; ``found`` says how one knows."""
    return MemobenchError(
        f"The feature cache {folder} does not fit on its disk: {found}; make room, store fewer frames "
        f"(--policy.memory_stride, `memobench cache --stride`), or {_ELSEWHERE}."
    )


@contextlib.contextmanager
def telling_of_the_disk(folder: Path) -> Iterator[None]:
    """Turn what the disk answers to writing a cache into one sentence.

    Raises:
        MemobenchError: the disk is full, or nothing may be written there.
    """
    try:
        yield
    except OSError as error:
        if error.errno in FULL:
            raise no_room(folder, f"it is full ({error.strerror})") from error
        if error.errno in _CLOSED and error.filename is not None and _is_of(Path(error.filename), folder):
            raise MemobenchError(
                f"The feature cache {folder} cannot be written ({error.strerror}); {_ELSEWHERE}."
            ) from error
        raise


def _is_of(path: Path, folder: Path) -> bool:
    """Whether a path is where a cache lies, or on the way to it; not a dataset's video."""
    return path.is_relative_to(folder.parent) or folder.is_relative_to(path)
