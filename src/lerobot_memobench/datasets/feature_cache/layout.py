"""Where a feature cache lies, what is in it, and whether it fits.

Caches made with another encoder (weights, input size, pooling), camera or stride have other names and lie side by side.

Layout of ``<dataset>/feature_cache/<name>/``, or of ``<name>/`` in a folder that was chosen for caches::

    meta.json       what the cache was made from (keys), sizes, and whether it is complete
    tokens.bin      bfloat16 (slots, P, D), seen as uint16; slot = one stored frame, episodes one after the other
    done.npy        uint8 (episodes,): which episodes' tokens are written; a killed build goes on from here
    episodes.npy    int64 (episodes + 1,): first frame of each episode in the dataset's global index
    phase.npy       uint8 (frames,): 0 prompt, 1 execution
    subgoal-<level>.npy  int32 (frames,): row of texts.json for the frame's subgoal, -1 for none
    texts.json, texts.npy    the unique subgoals and their embeddings, float32 (texts, d_t)
    texts-<hash>.npy         their embeddings by a text encoder that was used later
    hashes.json     sha256 of each of these files, written when they are complete
    memory.npy, memory.json    int32 (frames,): row of the frame's oracle memory text; the unique texts
"""

from __future__ import annotations

import glob
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypedDict, get_type_hints

import numpy as np

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_hash, file_name, read_json, short

FOLDER = "feature_cache"
FORMAT = 2
META_FILE, TOKENS_FILE, DONE_FILE, TEXTS_FILE = "meta.json", "tokens.bin", "done.npy", "texts.json"
HASHES_FILE = "hashes.json"
_SAMPLE = 1 << 16
"""Bytes of a video read for its fingerprint, at its start, middle and end."""


@dataclass
class CacheMeta:
    """Contents of ``meta.json``."""

    format: int
    dataset: str  # fingerprint of the dataset's content
    frames_key: str  # identity of the visual encoder
    texts_key: str  # identity of the text encoder that it was begun with
    camera: str
    stride: int
    tokens_per_frame: int
    dim: int
    slots: int
    levels: list[str]
    oracle: bool  # the dataset has the column of oracle memory texts
    complete: bool

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (slots, P, D) of the tokens."""
        return self.slots, self.tokens_per_frame, self.dim

    @property
    def frame_bytes(self) -> int:
        """Bytes of one stored frame's tokens: 64 KiB at full size."""
        return 2 * self.tokens_per_frame * self.dim

    @property
    def bytes(self) -> int:
        """Bytes of all tokens, next to which the rest is small."""
        return self.slots * self.frame_bytes

    def mismatch(self, wanted: dict[str, Any]) -> str | None:
        """Why the cache does not fit, as the end of a sentence; None when it does."""
        theirs, ours = short(self.camera), short(wanted.get("camera"))
        reasons = {
            "format": "has an older format",
            "dataset": "is stale: the dataset's frames changed after it was made",
            "frames_key": "is foreign: another visual encoder (other weights or input size) made it",
            "camera": f"is foreign: it shows camera {theirs}, and {ours} is asked for",
            "stride": f"is foreign: it was made with stride {self.stride}, and stride {wanted.get('stride')} is asked "
            "for",
        }
        return next((reasons[key] for key, value in wanted.items() if getattr(self, key) != value), None)


META_SCHEMA: Any = TypedDict("META_SCHEMA", get_type_hints(CacheMeta))  # type: ignore[misc]
"""What the file must hold before it is a `CacheMeta`."""

SIZES = ("stride", "tokens_per_frame", "dim", "slots")


def fix_hint(root: Path) -> str:
    """What a user types when a cache does not fit."""
    return f"Make it again with `memobench cache {root}`."


def read_meta(root: Path, name: str, place: Path | None = None) -> CacheMeta | None:
    """Description of a cache, complete or not; None when there is none.

    Args:
        place: folder that holds caches; the one beside the dataset ``root`` when None.
    """
    path = (place or Path(root) / FOLDER) / name / META_FILE
    if not path.is_file():
        return None
    advice = f"it is not a feature cache this version can read. {fix_hint(Path(root))}"
    found = read_json(path, META_SCHEMA, advice)
    if set(found) != set(META_SCHEMA.__annotations__) or min(map(found.__getitem__, SIZES)) < 1:
        raise MemobenchError(f"{path}: {advice}")
    return CacheMeta(**found)


def readable_meta(root: Path, name: str, place: Path | None = None) -> CacheMeta | None:
    """Like `read_meta`; what cannot be read counts as nothing."""
    try:
        return read_meta(root, name, place)
    except MemobenchError:
        return None


def check_cache(folder: Path) -> str | None:
    """Compare the files of a complete cache with their hashes; return a note where it has none.

    Raises:
        MemobenchError: one of them is missing or damaged.
    """
    advice = f"delete {folder}, and it is made again"
    try:
        hashes = read_json(folder / HASHES_FILE, dict[str, str], advice)
    except FileNotFoundError:
        return "it is not complete, or an earlier version made it, without hashes: it was not checked"
    for name, wanted in hashes.items():
        path = folder / file_name(name, f"a file in {folder / HASHES_FILE}")
        if not path.is_file() or file_hash(path) != wanted:
            raise MemobenchError(f"{name} is missing, or not as it was written; {advice}")
    return None


def find_cache(
    root: Path, prefix: str, *, frames_key: str, camera: str, stride: int, place: Path | None = None
) -> Path:
    """Return where the cache with these contents lies, or is to lie.

    Args:
        root: folder of the dataset.
        prefix: what its name begins with, for people; it need not tell caches apart.
        place: folder that holds caches, of several datasets perhaps; the one beside the dataset when None.
    """
    if place is not None:
        ends = f"{prefix}-{_short(dataset_fingerprint(root, camera), frames_key, camera, str(stride))}"
        same = sorted(place.glob(f"*-{glob.escape(ends)}"))  # of a dataset that had another name, or of a copy of it
        return same[0] if same else place / f"{root.resolve().name}-{ends}"
    folder = root / FOLDER / f"{prefix}-{_short(frames_key, camera, str(stride))}"
    earlier = None if folder.exists() else readable_meta(root, prefix)  # versions before the hash
    if earlier is not None and earlier.mismatch({"frames_key": frames_key, "camera": camera, "stride": stride}) is None:
        return root / FOLDER / prefix
    return folder


def texts_file(first: str, key: str) -> str:
    """Name of the embeddings by the text encoder ``key``, in a cache that was begun with the encoder ``first``."""
    return "texts.npy" if key == first else f"texts-{_short(key)}.npy"


def _short(*parts: str) -> str:
    return hashlib.blake2b("\n".join(parts).encode(), digest_size=4).hexdigest()


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


def slot_starts(episodes: np.ndarray, stride: int) -> np.ndarray:
    """(E + 1,) first slot of each episode: an episode of n frames stores frames 0, stride, ... below n."""
    counts = -(-np.diff(episodes) // stride)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
