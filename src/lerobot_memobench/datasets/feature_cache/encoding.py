"""The tokens of a memory cache: every stored frame through the frozen vision tower, episode by episode."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.decoding import FrameReader
from lerobot_memobench.datasets.feature_cache.frame_table import FrameTable
from lerobot_memobench.datasets.feature_cache.layout import TOKENS_FILE, CacheMeta, slot_starts
from lerobot_memobench.datasets.feature_cache.tables import read_done, write_done

Progress = Callable[[int, int], None]
"""Called as progress(episodes done, episodes in all)."""


class FrameEncoder(Protocol):
    """The frozen vision tower: images (N, 3, H, W) in [0, 1], or what else is read -> tokens (N, P, D) bfloat16."""

    tokens_per_frame: int
    dim: int

    @property
    def key(self) -> str:
        """Identity of the tower: weights and input size."""

    def __call__(self, images: Any, /) -> Tensor:
        """Encode."""


@dataclass(frozen=True)
class _Part:
    """Frames of one episode that the tower takes at once."""

    episode: int
    frames: list[int]
    slot: int  # where the first one's tokens go
    last: bool  # of its episode


@dataclass(frozen=True)
class Encoding:
    """A cache whose tokens are being written.

    Attributes:
        folder: of the cache; its file of tokens has its full size.
        batch_size: frames per pass of the tower. workers: threads that decode videos ahead of it.
    """

    folder: Path
    meta: CacheMeta
    table: FrameTable
    batch_size: int
    workers: int

    def run(self, frames: FrameEncoder, read: FrameReader, progress: Progress) -> None:
        """Encode every episode that is not marked done; its mark is written after its tokens are on the disk.

        Videos are decoded in threads, a few parts ahead; the tower takes the parts in their order, so that the file is
        the same whatever the number of threads, and a killed build has finished the first so many episodes. Tokens
        are written, not mapped: a disk that refuses a mapped page kills the process (SIGBUS).
        """
        done = read_done(self.folder, self.table.num_episodes)
        progress(int(done.sum()), len(done))
        with (
            (self.folder / TOKENS_FILE).open("r+b") as file,
            ThreadPoolExecutor(self.workers, thread_name_prefix="decode") as pool,
        ):
            parts = self._parts(np.flatnonzero(done == 0).tolist())
            for part, images in _ahead(pool, 2 * self.workers, parts, lambda part: read(part.episode, part.frames)):
                encoded = frames(images).to("cpu", torch.bfloat16).contiguous()
                file.seek(part.slot * self.meta.frame_bytes)
                file.write(encoded.view(torch.uint16).numpy().tobytes())
                if part.last:
                    file.flush()
                    os.fsync(file.fileno())
                    done[part.episode] = 1
                    write_done(self.folder, done)
                    progress(int(done.sum()), len(done))

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
