"""Names of a dataset's files and folders."""

from __future__ import annotations

import glob
import hashlib
import os
from contextlib import suppress
from pathlib import Path

from lerobot_memobench.io import cache_folder, files_below

STAGING = ".staging"
"""Folder of an unfinished run within its destination."""
DEFAULT_REPO_ID = "memobench/memobench"
MANIFEST_FILE = "manifest.json"
INFO_FILE = Path("meta") / "info.json"
STATS_FILE = Path("meta") / "stats.json"
TASKS_FILE = Path("meta") / "tasks.parquet"
EPISODES = "meta/episodes"
TOP_LEVEL = ("videos", "states", "data", "README.md", MANIFEST_FILE, "meta")
"""In the order in which they are moved into place; with `meta` the folder becomes a dataset."""
ADVICE = "the dataset is damaged; generate it or take it from its source again"


def is_dataset(folder: Path) -> bool:
    """Return whether ``folder`` holds a finished LeRobotDataset."""
    return (folder / INFO_FILE).is_file()


def dataset_files(folder: Path) -> list[str]:
    """Return the paths of a dataset's files below ``folder``, without card, manifest and caches."""
    folders = [folder / name for name in TOP_LEVEL if not Path(name).suffix]
    return sorted(path.relative_to(folder).as_posix() for part in folders for path in files_below(part))


def without_pattern(folder: Path) -> Path:
    """Return a path of a dataset's folder for LeRobot, which reads names such as ``obj [v2]`` as patterns of `glob`.

    It is the folder itself, or a link to it in the cache. The link is the same at every call, because LeRobot caches
    the tables by path.
    """
    place = str(folder.absolute())
    if glob.escape(place) == place or not folder.is_dir():
        return folder
    link = cache_folder() / "datasets" / hashlib.sha256(os.fsencode(place)).hexdigest()[:16]
    link.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        link.symlink_to(place)
    return link
