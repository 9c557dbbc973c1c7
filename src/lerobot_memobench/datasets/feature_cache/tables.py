"""Everything of a memory cache but its tokens: small tables, and the embeddings of the subgoal texts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from lerobot_memobench.datasets.feature_cache.frame_table import FrameTable
from lerobot_memobench.datasets.feature_cache.layout import DONE_FILE, META_FILE, TEXTS_FILE, CacheMeta, texts_file
from lerobot_memobench.io import draft_of, read_json, write_file


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


def write_tables(folder: Path, table: FrameTable, texts: TextEncoder) -> None:
    """Write the tables of a cache none of whose episodes is done."""
    write_done(folder, np.zeros(table.num_episodes, dtype=np.uint8))
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


def numbered(table: FrameTable) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return the subgoals that there are, and for each level their rows (N,) int32, -1 for none."""
    unique = sorted({text for values in table.subgoals.values() for text in values if text})
    number = {text: row for row, text in enumerate(unique)}
    rows = {level: [number.get(text, -1) for text in values] for level, values in table.subgoals.items()}
    return unique, {level: np.array(found, np.int32) for level, found in rows.items()}


def numbered_memory(memory: Sequence[str]) -> tuple[list[str], np.ndarray]:
    """Return the oracle memory texts that there are, and the row (N,) int32 of each frame's."""
    memories, rows = np.unique(np.array(memory, dtype=object), return_inverse=True)
    return memories.tolist(), rows.astype(np.int32)


def add_embeddings(folder: Path, meta: CacheMeta, texts: TextEncoder) -> None:
    """Write what another text encoder makes of the texts beside what the cache has; nothing if it is there."""
    path = folder / texts_file(meta.texts_key, texts.key)
    if not path.is_file():
        unique = read_json(folder / TEXTS_FILE, list[str], f"delete {folder}, and it is made again")
        _save_embeddings(path, unique, texts)


def read_done(folder: Path, episodes: int) -> np.ndarray:
    """Return which episodes (E,) are done, uint8; none, where the file is damaged or gone."""
    try:
        done = np.load(folder / DONE_FILE)
    except Exception:  # NumPy answers damaged arrays with errors of every type
        done = None
    whole = isinstance(done, np.ndarray) and done.dtype == np.uint8 and done.shape == (episodes,)
    return done if whole and (done <= 1).all() else np.zeros(episodes, dtype=np.uint8)


def write_meta(folder: Path, meta: CacheMeta) -> None:
    """Write the description of a cache, without which it is none."""
    _write_json(folder / META_FILE, asdict(meta))


def write_done(folder: Path, done: np.ndarray) -> None:
    """Write which episodes (E,) are done; on the disk before this returns, as their tokens are."""
    _save_array(folder / DONE_FILE, done, durable=True)


def _save_embeddings(path: Path, unique: list[str], texts: TextEncoder) -> None:
    embeddings = texts(unique).to(torch.float32).numpy() if unique else np.zeros((0, texts.dim), np.float32)
    _save_array(path, embeddings)


def _write_json(path: Path, value: Any) -> None:
    write_file(path, json.dumps(value, indent=1))


def _save_array(path: Path, array: np.ndarray, *, durable: bool = False) -> None:
    with draft_of(path, durable=durable) as draft:
        np.save(draft, array)
