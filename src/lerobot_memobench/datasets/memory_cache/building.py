"""Make a memory cache, or finish one."""

from __future__ import annotations

import json
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.memory_cache.decoding import FrameReader, frame_reader
from lerobot_memobench.datasets.memory_cache.frame_table import FrameTable, read_frame_table
from lerobot_memobench.datasets.memory_cache.layout import (
    DONE_FILE,
    FOLDER,
    FORMAT,
    META_FILE,
    TOKENS_FILE,
    CacheMeta,
    dataset_fingerprint,
    read_meta,
    slot_starts,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.files import draft_of, remove_drafts, write_file
from lerobot_memobench.jobs.locking import taking_turns

MOST_THREADS = 8

Progress = Callable[[int, int], None]
"""Called as progress(episodes done, episodes in all)."""


class FrameEncoder(Protocol):
    """The frozen vision tower: images (N, 3, H, W) in [0, 1] -> tokens (N, P, D) bfloat16."""

    tokens_per_frame: int
    dim: int

    @property
    def key(self) -> str:
        """Identity of the tower: weights and input size."""

    def __call__(self, images: Tensor) -> Tensor:
        """Encode."""


class TextEncoder(Protocol):
    """The frozen text encoder: texts -> embeddings (N, dim) float32."""

    @property
    def key(self) -> str:
        """Identity of the encoder."""

    @property
    def dim(self) -> int:
        """Width of an embedding."""

    def __call__(self, texts: Sequence[str]) -> Tensor:
        """Encode."""


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
) -> Path:
    """Build, or finish building, the cache ``<root>/memory_cache/<name>``; a fitting complete one is left alone.

    A killed build goes on with the first episode it did not finish. A cache that does not fit is made again. A second
    builder (another rank) waits, and finds the work done.

    Args:
        root: folder of a LeRobotDataset v3.0.
        frames: the frozen vision tower. texts: the frozen text encoder.
        camera: image column that memory shows. stride: every how many frames one is stored.
        batch_size: frames per pass of the tower.
        workers: threads that decode videos ahead of the tower; as many as there are cores, up to 8, by default.
        progress: called with (episodes done, episodes in all), first with what is done already.

    Returns:
        The cache's folder.

    Raises:
        MemobenchError: ``root`` is no dataset, or has no such camera.
    """
    root = Path(root)
    fingerprint = dataset_fingerprint(root, camera)
    folder = root / FOLDER / name
    folder.parent.mkdir(exist_ok=True)
    with taking_turns(folder.parent / f"{name}.lock"):
        table = read_frame_table(root)
        meta = _describe(table, fingerprint, frames, texts, camera, stride)
        complete = replace(meta, complete=True)
        existing = _existing(root, name)
        if existing == complete:
            if progress:
                progress(table.num_episodes, table.num_episodes)
            return folder
        read = frame_reader(root, camera)
        if existing != meta:
            _begin(folder, meta, table, texts)
        remove_drafts(folder)
        work = _Work(folder, meta, table, batch_size, workers or min(_cores(), MOST_THREADS))
        work.write_tokens(frames, read, progress)
        _write_json(folder / META_FILE, asdict(complete))
    return folder


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


def _existing(root: Path, name: str) -> CacheMeta | None:
    """What is there already; what cannot be read counts as nothing."""
    try:
        return read_meta(root, name)
    except MemobenchError:
        return None


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


# --- tables ---------------------------------------------------------------------------------------------------


def _begin(folder: Path, meta: CacheMeta, table: FrameTable, texts: TextEncoder) -> None:
    """Write everything but the tokens, whose place is made; ``meta.json`` last."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    _save_array(folder / DONE_FILE, np.zeros(table.num_episodes, dtype=np.uint8))
    _save_array(folder / "episodes.npy", table.episodes)
    _save_array(folder / "phase.npy", table.phase)
    _write_subgoals(folder, table, texts)
    _write_memory(folder, table)
    with (folder / TOKENS_FILE).open("wb") as file:
        file.truncate(2 * int(np.prod(meta.shape)))
    _write_json(folder / META_FILE, asdict(meta))


def _write_subgoals(folder: Path, table: FrameTable, texts: TextEncoder) -> None:
    unique = sorted({text for values in table.subgoals.values() for text in values if text})
    number = {text: row for row, text in enumerate(unique)}
    embeddings = texts(unique).to(torch.float32).numpy() if unique else np.zeros((0, texts.dim), np.float32)
    for level, values in table.subgoals.items():
        _save_array(folder / f"subgoal-{level}.npy", np.array([number.get(text, -1) for text in values], np.int32))
    _write_json(folder / "texts.json", unique)
    _save_array(folder / "texts.npy", embeddings)


def _write_memory(folder: Path, table: FrameTable) -> None:
    if table.memory is not None:
        unique, rows = np.unique(np.array(table.memory, dtype=object), return_inverse=True)
        _save_array(folder / "memory.npy", rows.astype(np.int32))
        _write_json(folder / "memory.json", unique.tolist())


def _write_json(path: Path, value: Any) -> None:
    write_file(path, json.dumps(value, indent=1))


def _save_array(path: Path, array: np.ndarray) -> None:
    with draft_of(path) as draft:
        np.save(draft, array)


# --- tokens ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Part:
    """Frames of one episode that the tower takes at once."""

    episode: int
    frames: list[int]
    slot: int  # where the first one's tokens go
    last: bool  # of its episode


@dataclass(frozen=True)
class _Work:
    """A cache whose tokens are being written."""

    folder: Path
    meta: CacheMeta
    table: FrameTable
    batch_size: int
    workers: int

    def write_tokens(self, frames: FrameEncoder, read: FrameReader, progress: Progress | None) -> None:
        """Encode every episode that is not marked done; its mark is written after its tokens have reached the file.

        Videos are decoded in threads, a few parts ahead; the tower takes the parts in their order, so that the file is
        the same whatever the number of threads, and a killed build has finished the first so many episodes.
        """
        tokens = np.memmap(self.folder / TOKENS_FILE, dtype=np.uint16, mode="r+", shape=self.meta.shape)
        done = np.load(self.folder / DONE_FILE, mmap_mode="r+")
        tell = progress or (lambda _done, _total: None)
        tell(int(done.sum()), len(done))
        with ThreadPoolExecutor(self.workers, thread_name_prefix="decode") as pool:
            parts = self._parts(np.flatnonzero(done == 0).tolist())
            for part, images in _ahead(pool, 2 * self.workers, parts, lambda part: read(part.episode, part.frames)):
                encoded = frames(images).to("cpu", torch.bfloat16).contiguous()
                tokens[part.slot : part.slot + len(part.frames)] = encoded.view(torch.uint16).numpy()
                if part.last:
                    tokens.flush()
                    done[part.episode] = 1
                    done.flush()
                    tell(int(done.sum()), len(done))

    def _parts(self, episodes: Sequence[int]) -> Iterator[_Part]:
        slots = slot_starts(self.table.episodes, self.meta.stride)
        lengths = np.diff(self.table.episodes)
        for episode in episodes:
            wanted = list(range(0, int(lengths[episode]), self.meta.stride))
            for first in range(0, len(wanted), self.batch_size):
                end = first + self.batch_size
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
