"""Files of a dataset: the hash of each in the manifest, and whether each is there, whole, and as it was written."""

from __future__ import annotations

from pathlib import Path

from lerobot_memobench.datasets.lerobot_format.layout import (
    ADVICE,
    MANIFEST_FILE,
    TOP_LEVEL,
    Written,
    read_manifest,
    read_to_end,
)
from lerobot_memobench.datasets.lerobot_format.reading import list_episodes
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched, file_hash

HASHED = tuple(name for name in TOP_LEVEL if Path(name).suffix == "")
"""Folders of a dataset; every file in them is hashed."""
COMPARED = ("task_name", "seed", "referent", "variant", "success", "scene_hash", "digest")
"""Fields of an episode in the manifest that its record has too."""
NO_HASHES = (
    "there are no hashes of files, as in datasets of earlier versions and after LeRobot's dataset tools: damage to a "
    "picture that can still be decoded and is not drawn again is not found"
)


def dataset_files(folder: Path) -> list[str]:
    """Return the files of the dataset in ``folder`` by their paths in it, without card, manifest and caches."""
    found = [path for name in HASHED for path in (folder / name).rglob("*") if path.is_file()]
    return sorted(path.relative_to(folder).as_posix() for path in found)


def written_files(folder: Path) -> dict[str, Written]:
    """Return size and hash of each of a dataset's files, for its manifest."""
    return {
        name: {"bytes": (folder / name).stat().st_size, "sha256": file_hash(folder / name)}
        for name in dataset_files(folder)
    }


def check_file(path: Path, written: Written | None) -> str | None:
    """Read a file to its end and compare it with what was written; return a note where it was written again.

    Other bytes in a file of the same size are damage; a tool that encodes or writes again leaves another size.

    Raises:
        MemobenchError: it is missing or damaged.
    """
    if not path.is_file():
        raise MemobenchError(f"the file is missing; {ADVICE}")
    check_fetched(path)
    if path.suffix in (".parquet", ".mp4"):
        read_to_end(path)
    if written is None or file_hash(path) == written["sha256"]:
        return None
    if path.stat().st_size == written["bytes"]:
        raise MemobenchError(
            f"it has as many bytes as {MANIFEST_FILE} says, and others: it was damaged or edited; take the dataset "
            "from its source again, or generate it"
        )
    return f"encoded or written again since {MANIFEST_FILE} was: its content is checked, its bytes are not"


def check_manifest(folder: Path) -> None:
    """Compare seeds, hashes and lengths in the manifest of the dataset in ``folder`` with its episodes.

    Raises:
        MemobenchError: naming the first episode and field that differ.
    """
    rows = {row.get("episode_index"): row for row in read_manifest(folder)["episodes"] if row["failure"] is None}
    for place in list_episodes(folder) if None not in rows else ():  # a manifest of an earlier version
        row = rows.pop(place.index, {})
        held = {key: getattr(place.record, key) for key in COMPARED} if place.record is not None else {}
        for key, value in {"frames": place.length, **held}.items():
            if row.get(key) != value and value is not None:
                raise MemobenchError(f"episode {place.index} has {key}={value!r}, {MANIFEST_FILE} {row.get(key)!r}")
    if rows:
        raise MemobenchError(f"it names episode {next(iter(rows))}, and the dataset has none of that number")
