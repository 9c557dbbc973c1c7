"""Memory cache: what a memory policy would otherwise recompute for every sample, made once beside the dataset.

It holds the pooled tokens of the frozen vision tower for every ``stride``-th frame of one camera, the embedding of
every subgoal text, and per frame its phase and subgoal. Everything large is memory-mapped, so training gathers 32
frames of history without decoding a video (delta timestamps are fixed offsets and cannot say "spread over the episode
so far").

Layout of ``<dataset>/memory_cache/<name>/``::

    meta.json       what the cache was made from (keys), sizes, and whether it is complete
    tokens.bin      bfloat16 (slots, P, D), seen as uint16; slot = one stored frame, episodes one after the other
    done.npy        uint8 (episodes,): which episodes' tokens are written; a killed build goes on from here
    episodes.npy    int64 (episodes + 1,): first frame of each episode in the dataset's global index
    phase.npy       uint8 (frames,): 0 prompt, 1 execution
    subgoal-<level>.npy  int32 (frames,): row of texts.json for the frame's subgoal, -1 for none
    texts.json, texts.npy    the unique subgoals and their embeddings, float32 (texts, d_t)
    memory.npy, memory.json    int32 (frames,): row of the frame's oracle memory text; the unique texts
"""

from __future__ import annotations

import fcntl
import hashlib
import itertools
import json
import os
import shutil
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow.parquet as pq
import torch
from torch import Tensor

from lerobot_memobench.errors import MemobenchError

FOLDER = "memory_cache"
FORMAT = 2
LEVEL_COLUMNS = {"coarse": "coarse_subgoal", "intermediate": "simple_subgoal", "fine": "grounded_subgoal"}
MEMORY_COLUMN = "memory"
_SAMPLE = 1 << 16  # bytes of a video read for its fingerprint, at its start, middle and end

Progress = Callable[[int, int], None]  # called as progress(episodes done, episodes in all)


class FrameEncoder(Protocol):
    """The frozen vision tower: images (N, 3, H, W) in [0, 1] -> tokens (N, P, D) bfloat16."""

    tokens_per_frame: int
    dim: int

    @property
    def key(self) -> str: ...

    def __call__(self, images: Tensor) -> Tensor: ...


class TextEncoder(Protocol):
    """The frozen text encoder: texts -> embeddings (N, dim) float32."""

    @property
    def key(self) -> str: ...

    @property
    def dim(self) -> int: ...

    def __call__(self, texts: Sequence[str]) -> Tensor: ...


@dataclass
class CacheMeta:
    """Contents of ``meta.json``."""

    format: int
    dataset: str  # fingerprint of the dataset's content
    frames_key: str  # identity of the vision tower
    texts_key: str  # identity of the text encoder
    camera: str
    stride: int
    tokens_per_frame: int
    dim: int
    slots: int
    levels: list[str]
    oracle: bool  # the dataset has the column of oracle memory texts
    complete: bool


def fix_hint(root: Path) -> str:
    """What a user types when a cache does not fit."""
    return f"Make it again with `memobench cache {root}`."


def dataset_fingerprint(root: Path, camera: str) -> str:
    """Hash of what a cache depends on: the frame tables in full, the camera's videos by size and three samples each.

    It does not depend on where the dataset lies, nor on the other cameras or the card.

    Raises:
        MemobenchError: ``root`` holds no LeRobotDataset.
    """
    if not (root / "meta" / "info.json").is_file():
        raise MemobenchError(
            f"{root} is no LeRobotDataset: it has no meta/info.json; give the folder that holds meta, data and videos."
        )
    digest = hashlib.blake2b(digest_size=12)
    for path in sorted((root / "data").rglob("*.parquet")):
        digest.update(str(path.relative_to(root)).encode())
        digest.update(path.read_bytes())
    for path in sorted((root / "videos" / camera).rglob("*.mp4")):
        size = path.stat().st_size
        digest.update(f"{path.relative_to(root)}{size}".encode())
        with path.open("rb") as file:
            for start in {0, max(0, size // 2), max(0, size - _SAMPLE)}:
                file.seek(start)
                digest.update(file.read(_SAMPLE))
    return digest.hexdigest()


def _write_json(path: Path, value: Any) -> None:
    """Write a file so that a reader sees the old or the new one, never half of it."""
    temporary = path.with_suffix(".part")
    temporary.write_text(json.dumps(value, indent=1))
    os.replace(temporary, path)


def _save_array(path: Path, array: np.ndarray) -> None:
    temporary = path.with_suffix(".part")
    with temporary.open("wb") as file:
        np.save(file, array)
    os.replace(temporary, path)


@dataclass
class _Frames:
    """The dataset's per-frame tables, in the order of its global index."""

    episodes: np.ndarray  # (E + 1,) int64: first frame of each episode
    phase: np.ndarray  # (N,) uint8
    subgoals: dict[str, list[str]]  # level -> (N,) texts
    memory: list[str] | None  # (N,) oracle memory texts; None without the column


def _read_frames(root: Path) -> _Frames:
    """Read phase and subgoals of every frame.

    Raises:
        MemobenchError: the frames are not numbered 0, 1, 2, ... or an episode is not contiguous.
    """
    files = sorted((root / "data").rglob("*.parquet"))
    columns = ["index", "episode_index", "frame_index"]
    present = pq.read_schema(files[0]).names if files else []
    levels = {level: column for level, column in LEVEL_COLUMNS.items() if column in present}
    optional = [name for name in ("phase", MEMORY_COLUMN) if name in present]
    tables = [pq.read_table(path, columns=columns + optional + list(levels.values())) for path in files]
    if not tables:
        raise MemobenchError(f"{root} holds no frames: there is no parquet file below {root / 'data'}.")

    def column(name: str) -> np.ndarray:
        return np.concatenate([np.asarray(table.column(name).to_pylist()).reshape(-1) for table in tables])

    order = np.argsort(column("index"), kind="stable")
    index, episode, frame = (column(name)[order] for name in columns)
    starts = np.flatnonzero(frame == 0)
    expected = np.arange(len(index))
    if not np.array_equal(index, expected) or not np.array_equal(
        episode, np.searchsorted(starts, expected, "right") - 1
    ):
        raise MemobenchError(
            f"The frames of {root} are not numbered 0, 1, 2, ... episode by episode; write the dataset again."
        )

    def texts(name: str) -> list[str]:
        found = [text for table in tables for text in _strings(table.column(name).to_pylist())]
        return [found[i] for i in order]

    return _Frames(
        episodes=np.append(starts, len(index)).astype(np.int64),
        phase=(column("phase")[order] if "phase" in optional else np.ones(len(index))).astype(np.uint8),
        subgoals={level: texts(name) for level, name in levels.items()},
        memory=texts(MEMORY_COLUMN) if MEMORY_COLUMN in optional else None,
    )


def _strings(values: list[Any]) -> list[str]:
    """String columns arrive as strings or as lists of one string; a missing one is empty."""
    return [(value[0] if isinstance(value, list) else value) or "" for value in values]


def resolve_subgoals(rows: np.ndarray, episodes: np.ndarray) -> np.ndarray:
    """Give frames without a text the text of the next annotated step of their episode, or else of the last one.

    Args:
        rows: (N,) text number per frame, -1 where a frame has none.
        episodes: (E + 1,) first frame of each episode.

    Returns:
        (N,) text numbers; -1 is left only in episodes without any text (paper, framewise alignment).
    """
    resolved = rows.copy()
    for start, end in itertools.pairwise(episodes):
        annotated = np.flatnonzero(rows[start:end] >= 0)
        if len(annotated) == 0:
            continue
        following = np.searchsorted(annotated, np.arange(end - start)).clip(max=len(annotated) - 1)
        resolved[start:end] = rows[start:end][annotated[following]]
    return resolved


class MemoryCache:
    """A complete cache, read through memory maps. Open one with :meth:`open`."""

    def __init__(self, folder: Path, meta: CacheMeta) -> None:
        self.folder, self.meta = folder, meta
        self.episodes: np.ndarray = np.load(folder / "episodes.npy")
        self.phase: np.ndarray = np.load(folder / "phase.npy")
        self.slots = _slot_starts(self.episodes, meta.stride)
        shape = (meta.slots, meta.tokens_per_frame, meta.dim)
        self._tokens = np.memmap(folder / "tokens.bin", dtype=np.uint16, mode="r", shape=shape)
        self._subgoals = {
            level: resolve_subgoals(np.load(folder / f"subgoal-{level}.npy"), self.episodes) for level in meta.levels
        }
        self.texts: list[str] = json.loads((folder / "texts.json").read_text())
        self.text_embeddings = torch.from_numpy(np.load(folder / "texts.npy"))
        self._memory: np.ndarray | None = np.load(folder / "memory.npy") if meta.oracle else None
        self.memories: list[str] = json.loads((folder / "memory.json").read_text()) if meta.oracle else []

    @classmethod
    def open(
        cls, root: Path, name: str, *, frames_key: str, camera: str, stride: int, texts_key: str | None = None
    ) -> MemoryCache:
        """Open ``<root>/memory_cache/<name>`` after checking that it fits.

        Args:
            root: folder of the LeRobotDataset.
            frames_key: identity of the vision tower that will read the cache.
            texts_key: identity of the text encoder; None when no text is needed.

        Raises:
            MemobenchError: no cache, an unfinished one, one of another dataset (stale), or one made by another tower,
                camera, stride or text encoder (foreign). The message names the reason and the fix.
        """
        root = Path(root)
        meta = read_meta(root, name)
        if meta is None:
            raise MemobenchError(f"{root} has no memory cache '{name}'. {fix_hint(root)}")
        wanted = {
            "format": FORMAT,
            "dataset": dataset_fingerprint(root, camera),
            "frames_key": frames_key,
            "camera": camera,
            "stride": stride,
        }
        if texts_key is not None:
            wanted["texts_key"] = texts_key
        reason = _mismatch(meta, wanted)
        if reason:
            raise MemobenchError(f"The memory cache {root / FOLDER / name} {reason}. {fix_hint(root)}")
        if not meta.complete:
            raise MemobenchError(
                f"The memory cache {root / FOLDER / name} is not finished. Go on with `memobench cache {root}`."
            )
        return cls(root / FOLDER / name, meta)

    @property
    def num_frames(self) -> int:
        """Frames of the dataset."""
        return int(self.episodes[-1])

    def locate(self, index: int) -> tuple[int, int]:
        """Episode and frame in it, of a frame of the dataset's global index."""
        if not 0 <= index < self.num_frames:
            raise MemobenchError(
                f"Frame {index} lies outside the memory cache {self.folder}, which has {self.num_frames} frames. "
                f"{fix_hint(self.folder.parent.parent)}"
            )
        episode = int(np.searchsorted(self.episodes, index, "right")) - 1
        return episode, index - int(self.episodes[episode])

    def tokens(self, episode: int, slots: Sequence[int]) -> Tensor:
        """Tokens (n, P, D) bfloat16 of stored frames of an episode; slot k is its frame k * stride."""
        rows = np.asarray(slots, dtype=np.int64) + self.slots[episode]
        return torch.from_numpy(self._tokens[rows]).view(torch.bfloat16)

    def memory_texts(self, indices: Sequence[int]) -> list[str]:
        """Oracle memory texts of frames of the dataset, by their global indices.

        Raises:
            MemobenchError: the dataset has no such column.
        """
        if self._memory is None:
            raise MemobenchError(
                f"The dataset of {self.folder} has no column '{MEMORY_COLUMN}', which --policy.oracle_memory=true "
                "reads; generate it again with this version."
            )
        return [self.memories[row] for row in self._memory[np.asarray(indices, dtype=np.int64)].tolist()]

    def text_rows(self, level: str) -> np.ndarray:
        """(N,) int32: row of :attr:`text_embeddings` for each frame of the dataset; -1 where there is none.

        Raises:
            MemobenchError: the dataset has no texts at this level.
        """
        if level not in self._subgoals:
            known = ", ".join(self._subgoals) or "none"
            raise MemobenchError(
                f"The dataset of {self.folder} has no subgoals at level '{level}' (column {LEVEL_COLUMNS[level]}); "
                f"levels it has: {known}. Choose one with --policy.subgoal_level."
            )
        return self._subgoals[level]


def _mismatch(meta: CacheMeta, wanted: dict[str, Any]) -> str | None:
    """Why a cache does not fit, as the end of a sentence; None when it does."""
    reasons = {
        "format": "has an older format",
        "dataset": "is stale: the dataset's frames changed after it was made",
        "frames_key": "is foreign: another vision tower (other weights or input size) made it",
        "texts_key": "is foreign: another text encoder made it",
        "camera": f"is foreign: it shows camera '{meta.camera}', and '{wanted.get('camera')}' is asked for",
        "stride": f"is foreign: it was made with stride {meta.stride}, and stride {wanted.get('stride')} is asked for",
    }
    return next((reasons[key] for key, value in wanted.items() if getattr(meta, key) != value), None)


def read_meta(root: Path, name: str) -> CacheMeta | None:
    """Description of a cache, complete or not; None when there is none."""
    path = Path(root) / FOLDER / name / "meta.json"
    if not path.is_file():
        return None
    try:
        return CacheMeta(**json.loads(path.read_text()))
    except (TypeError, json.JSONDecodeError):
        raise MemobenchError(f"{path} is not a memory cache this version can read. {fix_hint(Path(root))}") from None


def _slot_starts(episodes: np.ndarray, stride: int) -> np.ndarray:
    """(E + 1,) first slot of each episode: an episode of n frames stores frames 0, stride, ... below n."""
    counts = -(-np.diff(episodes) // stride)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold a lock file; a second builder (another rank) waits, and finds the work done. A kill releases it."""
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


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

    A killed build goes on with the first episode it did not finish. A cache that does not fit is made again.

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
    with _lock(folder.parent / f"{name}.lock"):
        table = _read_frames(root)
        meta = CacheMeta(
            format=FORMAT,
            dataset=fingerprint,
            frames_key=frames.key,
            texts_key=texts.key,
            camera=camera,
            stride=stride,
            tokens_per_frame=frames.tokens_per_frame,
            dim=frames.dim,
            slots=int(_slot_starts(table.episodes, stride)[-1]),
            levels=list(table.subgoals),
            oracle=table.memory is not None,
            complete=False,
        )
        try:
            existing = read_meta(root, name)
        except MemobenchError:
            existing = None
        if existing is not None and asdict(existing) == {**asdict(meta), "complete": True}:
            if progress:
                progress(len(table.episodes) - 1, len(table.episodes) - 1)
            return folder
        reader = _reader(root, camera)
        if existing != meta:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            _save_array(folder / "done.npy", np.zeros(len(table.episodes) - 1, dtype=np.uint8))
            _write_tables(folder, table, texts)
            with (folder / "tokens.bin").open("wb") as file:
                file.truncate(2 * meta.slots * meta.tokens_per_frame * meta.dim)
            _write_json(folder / "meta.json", asdict(meta))
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        _write_tokens(folder, meta, table, frames, reader, batch_size, workers or min(cores, 8), progress)
        _write_json(folder / "meta.json", asdict(meta) | {"complete": True})
    return folder


def _write_tables(folder: Path, table: _Frames, texts: TextEncoder) -> None:
    unique = sorted({text for values in table.subgoals.values() for text in values if text})
    number = {text: row for row, text in enumerate(unique)}
    embeddings = texts(unique).to(torch.float32).numpy() if unique else np.zeros((0, texts.dim), np.float32)
    _save_array(folder / "episodes.npy", table.episodes)
    _save_array(folder / "phase.npy", table.phase)
    for level, values in table.subgoals.items():
        _save_array(folder / f"subgoal-{level}.npy", np.array([number.get(text, -1) for text in values], np.int32))
    _write_json(folder / "texts.json", unique)
    _save_array(folder / "texts.npy", embeddings)
    if table.memory is not None:
        memories = sorted(set(table.memory))
        place = {text: row for row, text in enumerate(memories)}
        _save_array(folder / "memory.npy", np.array([place[text] for text in table.memory], np.int32))
        _write_json(folder / "memory.json", memories)


def _write_tokens(
    folder: Path,
    meta: CacheMeta,
    table: _Frames,
    frames: FrameEncoder,
    read: Callable[[int, list[int]], Tensor],
    batch_size: int,
    workers: int,
    progress: Progress | None,
) -> None:
    """Encode every episode that is not marked done; its mark is written after its tokens have reached the file.

    Videos are decoded in threads, a few parts ahead; the tower takes the parts in their order, so that the file is the
    same whatever the number of threads, and a killed build has finished the first so many episodes.
    """
    slots = _slot_starts(table.episodes, meta.stride)
    shape = (meta.slots, meta.tokens_per_frame, meta.dim)
    tokens = np.memmap(folder / "tokens.bin", dtype=np.uint16, mode="r+", shape=shape)
    done = np.load(folder / "done.npy", mmap_mode="r+")
    count = len(done)
    if progress:
        progress(int(done.sum()), count)

    def parts() -> Iterator[tuple[int, int, list[int], bool]]:
        """Episode, first slot in it, frames, and whether they are its last."""
        for episode in np.flatnonzero(done == 0).tolist():
            length = int(table.episodes[episode + 1] - table.episodes[episode])
            wanted = list(range(0, length, meta.stride))
            for first in range(0, len(wanted), batch_size):
                yield episode, first, wanted[first : first + batch_size], first + batch_size >= len(wanted)

    with ThreadPoolExecutor(workers, thread_name_prefix="decode") as pool:
        for (episode, first, part, last), images in _ahead(pool, 2 * workers, parts(), lambda p: read(p[0], p[2])):
            encoded = frames(images).to("cpu", torch.bfloat16).contiguous()
            place = int(slots[episode]) + first
            tokens[place : place + len(part)] = encoded.view(torch.uint16).numpy()
            if not last:
                continue
            tokens.flush()
            done[episode] = 1
            done.flush()
            if progress:
                progress(int(done.sum()), count)


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


def _reader(root: Path, camera: str) -> Callable[[int, list[int]], Tensor]:
    """Function from (episode, frame numbers) to images (n, 3, H, W) float32 in [0, 1], decoded in one sweep."""
    from lerobot.datasets import video_utils
    from lerobot.datasets.dataset_metadata import LeRobotDatasetMetadata

    meta = LeRobotDatasetMetadata(root.name, root=root)
    if camera not in meta.camera_keys:
        raise MemobenchError(
            f"The dataset {root} has no camera '{camera}'; it has {', '.join(meta.camera_keys) or 'none'}. "
            "Choose one with --policy.memory_camera."
        )
    if camera not in meta.video_keys:
        return _image_reader(root, camera, meta)

    backend = video_utils.get_safe_default_video_backend()
    own = threading.local()
    table_lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with table_lock:
            row = meta.episodes[episode]
            path = root / meta.get_video_file_path(episode, camera)
        start = row[f"videos/{camera}/from_timestamp"]
        times = [start + number / meta.fps for number in numbers]
        if backend == "torchcodec":
            # LeRobot's decoders are shared within a process, and none may be used by two threads at a time.
            if not hasattr(own, "decoders"):
                own.decoders = video_utils.VideoDecoderCache(max_size=1)
            images = video_utils.decode_video_frames_torchcodec(path, times, 1e-4, decoder_cache=own.decoders)
        else:
            images = video_utils.decode_video_frames(path, times, tolerance_s=1e-4, backend=backend)
        return images.reshape(len(numbers), *_CHW(meta, camera))

    return read


def _CHW(meta: Any, camera: str) -> tuple[int, int, int]:
    height, width, channels = meta.features[camera]["shape"]
    return channels, height, width


def _image_reader(root: Path, camera: str, meta: Any) -> Callable[[int, list[int]], Tensor]:
    """Reader of datasets that keep images in their tables."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset(root.name, root=root)
    starts = meta.episodes["dataset_from_index"]
    lock = threading.Lock()

    def read(episode: int, numbers: list[int]) -> Tensor:
        with lock:
            return torch.stack([dataset[starts[episode] + number][camera] for number in numbers])

    return read
