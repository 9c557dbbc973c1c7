"""Read a complete memory cache, through memory maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frame_table import resolve_subgoals
from lerobot_memobench.datasets.feature_cache.layout import (
    FOLDER,
    FORMAT,
    TEXTS_FILE,
    TOKENS_FILE,
    CacheMeta,
    dataset_fingerprint,
    fix_hint,
    read_meta,
    slot_starts,
    texts_file,
)
from lerobot_memobench.datasets.feature_cache.lookup import FrameLookup
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_name, read_json


class MemoryCache(FrameLookup):
    """A complete cache, read through memory maps. Open one with :meth:`open`."""

    def __init__(self, folder: Path, meta: CacheMeta, texts_key: str | None = None) -> None:
        self.folder, self.root, self.meta = folder, folder.parent.parent, meta
        self.episodes: np.ndarray = np.load(folder / "episodes.npy")
        self.phase: np.ndarray = np.load(folder / "phase.npy")
        self.slots = slot_starts(self.episodes, meta.stride)
        self._tokens = np.memmap(folder / TOKENS_FILE, dtype=np.uint16, mode="r", shape=meta.shape)
        self.subgoal_rows = {
            level: resolve_subgoals(
                np.load(folder / file_name(f"subgoal-{level}.npy", "the table of a level")), self.episodes
            )
            for level in meta.levels
        }
        self.texts: list[str] = read_json(folder / TEXTS_FILE, list[str], "it is damaged")
        embeddings = folder / texts_file(meta.texts_key, texts_key or meta.texts_key)
        self.text_embeddings = torch.from_numpy(np.load(embeddings))
        self.memory_rows = np.load(folder / "memory.npy") if meta.oracle else None
        self.memories: list[str] = read_json(folder / "memory.json", list[str], "it is damaged") if meta.oracle else []
        self._check()

    def _check(self) -> None:
        """Raise a ValueError unless the tables are those of one dataset."""
        frames, episodes = self.num_frames, len(self.episodes)
        tables = [(rows, len(self.texts)) for rows in self.subgoal_rows.values()]
        tables += [] if self.memory_rows is None else [(self.memory_rows, len(self.memories))]
        fitting = (
            episodes > 0
            and (np.diff(self.episodes) > 0).all()
            and (self.episodes[0], self.slots[-1]) == (0, self.meta.slots)
            and self.phase.shape == (frames,)
            and self.text_embeddings.shape[:1] == (len(self.texts),)
            and all(rows.shape == (frames,) and rows.max(initial=-1) < count for rows, count in tables)
        )
        if not fitting:
            raise ValueError("its tables are not of one dataset")

    @classmethod
    def open(
        cls,
        root: Path,
        name: str,
        *,
        frames_key: str,
        camera: str,
        stride: int,
        texts_key: str | None = None,
        place: Path | None = None,
    ) -> MemoryCache:
        """Open ``<root>/memory_cache/<name>`` after checking that it fits.

        Args:
            root: folder of the LeRobotDataset.
            frames_key: identity of the vision tower that will read the cache.
            texts_key: identity of the text encoder; None when no text is needed.
            place: folder that holds caches, where it is not the one beside the dataset.

        Raises:
            MemobenchError: no cache, an unfinished one, one of another dataset (stale), or one made by another tower,
                camera, stride or text encoder (foreign). The message names the reason and the fix.
        """
        root = Path(root)
        meta, folder = read_meta(root, name, place), (place or root / FOLDER) / name
        if meta is None:
            raise MemobenchError(f"{folder.parent} has no memory cache '{name}'. {fix_hint(root)}")
        wanted = {
            "format": FORMAT,
            "dataset": dataset_fingerprint(root, camera),
            "frames_key": frames_key,
            "camera": camera,
            "stride": stride,
        }
        reason = meta.mismatch(wanted)
        if reason is None and texts_key is not None and not (folder / texts_file(meta.texts_key, texts_key)).is_file():
            reason = "is foreign: another text encoder made it"
        if reason:
            raise MemobenchError(f"The memory cache {folder} {reason}. {fix_hint(root)}")
        if not meta.complete:
            raise MemobenchError(f"The memory cache {folder} is not finished. Go on with `memobench cache {root}`.")
        try:
            return cls(folder, meta, texts_key)
        except Exception as error:  # NumPy answers damaged arrays with errors of every type
            told = " ".join(str(error).split())[:200]
            raise MemobenchError(
                f"The memory cache {folder} is damaged ({told}). Delete that folder. {fix_hint(root)}"
            ) from None

    def all_tokens(self) -> Tensor:
        """Tokens (slots, P, D) bfloat16 of all stored frames, mapped: read where they are looked at."""
        path, shape = self.folder / TOKENS_FILE, self.meta.shape
        return torch.from_file(str(path), size=math.prod(shape), dtype=torch.bfloat16).view(shape)

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Tokens (n, P, D) bfloat16 of stored frames of an episode; slot k is its frame k * stride."""
        rows = np.asarray(slots, dtype=np.int64) + self.slots[episode]
        return torch.from_numpy(self._tokens[rows]).view(torch.bfloat16)
