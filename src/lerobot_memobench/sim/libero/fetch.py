"""Download LIBERO's assets, and copy the files that scenes read into a folder for a machine without a network."""

from __future__ import annotations

from pathlib import Path

import httpx
from huggingface_hub import snapshot_download

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import disk_refusal, file_hash, write_file
from lerobot_memobench.sim.libero import files


def obtain() -> files.Place:
    """Return the place of LIBERO's assets, after downloading them to the hub's cache if no place has all files.

    Raises:
        MemobenchError: the hub cannot be reached, or has other files.
    """
    found = files.places()
    if (place := files.usable(found)) is not None:
        return place
    wanted, damaged = [*files.known_hashes()], any(place.source == files.HUB_CACHE for place in found)
    try:
        snapshot_download(files.REPOSITORY, repo_type="dataset", allow_patterns=wanted, force_download=damaged)
    except (OSError, httpx.TransportError) as error:
        if disk_refusal(error):
            raise
        problem = f"{files.REPOSITORY} could not be fetched from the hub ({' '.join(str(error).split())[:300]})"
        raise MemobenchError(f"{problem}; run: {files.INSTALL}, or {files.CARRY}") from None
    return files.located()


def copy_to(folder: Path) -> int:
    """Copy the files that scenes read, and their terms, into a folder; return their size, bytes.

    Files with the right content stay, so the same call continues an interrupted one.

    Raises:
        MemobenchError: the folder has another file of a name, or no place has all files.
    """
    source, size = files.check_assets(), 0
    for name, known in files.known_hashes().items():
        target = folder / name
        if not target.exists():
            target.parent.mkdir(parents=True, exist_ok=True)
            write_file(target, (source / name).read_bytes())
        if not target.is_file() or file_hash(target) != known:
            raise MemobenchError(f"{target} exists with other content; name another folder")
        size += target.stat().st_size
    write_file(folder / "TERMS.txt", f"{files.TERMS}.\n")
    return size
