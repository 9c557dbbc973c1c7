"""A dataset's folder: names of files and columns, its metadata, and whether all of it is there and whole."""

from __future__ import annotations

import glob
import hashlib
import math
import os
import shlex
import traceback
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.datasets.demonstration import MAX_CHECKPOINTS
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    Count,
    Whole,
    cache_folder,
    check_fetched,
    count_of,
    read_json,
    refusing,
)
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, CLOCK, PROPRIO_DIM

STAGING = ".staging"
"""Folder of an unfinished run within its destination."""
DEFAULT_REPO_ID = "memobench/memobench"
MANIFEST_FILE = "manifest.json"
INFO_FILE = Path("meta") / "info.json"
STATS_FILE = Path("meta") / "stats.json"
TASKS_FILE = Path("meta") / "tasks.parquet"
TOP_LEVEL = ("videos", "states", "data", "README.md", MANIFEST_FILE, "meta")
"""Moved into place in this order; with `meta` the folder becomes a dataset, without it the manifest is the last."""
EPISODE_INFO = "episode_info"
"""The frames' column; empty but at an episode's first frame."""
LANGUAGE = "language_persistent"
"""LeRobot's column of language rows."""
OBJECTS = "observation.environment_state"
"""Visible objects, in datasets without pictures: LeRobot takes a column of this name for an input."""
PRIVILEGED = "privileged.environment_state"
"""The same in datasets with pictures, so that LeRobot's own commands train on no object poses there."""
EXECUTED_ACTION = "executed_action"
"""The action that moved the arm; `action` is the expert's, which differs where the arm was moved off its way. LeRobot
takes every column that begins with `action` for something to be learned."""
PROPRIO_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"]
ACTION_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper"]
ADVICE = "the dataset is damaged; generate it or take it from its source again"
NO_MANIFEST = "it is no manifest that this package wrote; take the dataset from its source again"
EARLIER_FORMATS = ("v1.6", "v2.0", "v2.1")
MOST_NUMBERS = 50_000_000
"""Limit of numbers of a feature in one frame: a picture of 4096 x 4096. LeRobot allocates memory for all of them."""


def is_dataset(folder: Path) -> bool:
    """Whether ``folder`` holds a finished LeRobotDataset."""
    return (folder / INFO_FILE).is_file()


def check_destination(out: Path) -> None:
    """Raise unless ``out`` is absent, empty, or holds nothing but an unfinished run."""
    if is_dataset(out):
        raise MemobenchError(f"{out} already holds a finished dataset; name another folder or delete this one first")
    if ":" in str(out) and not out.is_absolute():
        raise MemobenchError(f"{out} holds a colon, which Arrow reads as an address; name it by its whole path")
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file, expected a folder to write a dataset to; name another path")
    # Files that an interrupted move left next to the staging folder are replaced.
    strangers = [p.name for p in out.iterdir() if p.name != STAGING] if out.is_dir() else []
    if strangers and not ((out / STAGING).is_dir() and set(strangers) <= set(TOP_LEVEL)):
        raise MemobenchError(
            f"{out} holds {', '.join(sorted(strangers)[:3])}, no part of a dataset being made; name an empty folder"
        )


def dataset_files(folder: Path) -> list[str]:
    """Return the files of the dataset in ``folder`` by their paths in it, without card, manifest and caches."""
    folders = [folder / name for name in TOP_LEVEL if not Path(name).suffix]
    found = [path for part in folders for path in part.rglob("*") if path.is_file()]
    return sorted(path.relative_to(folder).as_posix() for path in found)


# --- columns ---


def image_key(camera: str) -> str:
    """Return the column name of a camera; the env's observations arrive at a policy under the same name."""
    return f"observation.images.{camera}"


def objects_column(names: Collection[str]) -> str:
    """Return which of a dataset's columns holds the objects.

    Datasets with pictures of earlier versions have them under LeRobot's name.
    """
    return PRIVILEGED if PRIVILEGED in names else OBJECTS


def check_clock(names: Collection[str], where: Path | str) -> None:
    """Refuse a dataset of an earlier version: its prompts would be taken for execution.

    Args:
        names: its columns. where: its folder.

    Raises:
        MemobenchError: it has the column ``phase`` of that version, and not today's.
    """
    if {"phase", "simple_subgoal"} <= set(names) and not set(CLOCK) <= set(names):
        raise MemobenchError(
            f"{where} was made by an earlier version: it has the column phase, and not {' and '.join(CLOCK)}; generate "
            "or convert it again"
        )


def dataset_features(image_size: tuple[int, int] | None) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns; ``image_size`` is (height, width), None without images."""
    from lerobot_memobench.sim.object_layout import SIZE

    def feature(dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": shape, "names": names}

    features: dict[str, dict[str, Any]] = {}
    if image_size is not None:
        for camera in CAMERAS:
            features[image_key(camera)] = feature("video", (*image_size, 3), ["height", "width", "channels"])
    features[OBJECTS if image_size is None else PRIVILEGED] = feature("float32", (SIZE,))
    completed = [f"checkpoint_{k}" for k in range(MAX_CHECKPOINTS)]
    return features | {
        "observation.state": feature("float32", (PROPRIO_DIM,), PROPRIO_NAMES),
        "action": feature("float32", (ACTION_DIM,), ACTION_NAMES),
        EXECUTED_ACTION: feature("float32", (ACTION_DIM,), ACTION_NAMES),
        **dict.fromkeys(CLOCK, feature("float32")),
        "checkpoint.index": feature("int64"),
        "checkpoint.operation": feature("int64"),
        "checkpoint.completed": feature("bool", (MAX_CHECKPOINTS,), completed),
        "checkpoint.event": feature("bool"),
        "simple_subgoal": feature("string"),
        "grounded_subgoal": feature("string"),
        "coarse_subgoal": feature("string"),
        "memory": feature("string"),
        "language_persistent": feature("language"),
        EPISODE_INFO: feature("string"),
    }


# --- metadata ---


class Info(TypedDict):
    """A dataset as a whole. Each of its episodes is read, so their number is bounded."""

    codebase_version: str
    total_episodes: Annotated[int, Ge(0), Le(10_000_000)]
    total_frames: NotRequired[Count]
    fps: NotRequired[Annotated[int, Ge(1), Le(10_000)]]
    features: dict[str, dict[str, Any]]


def read_info(folder: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of the dataset in ``folder``.

    Raises:
        MemobenchError: there is none, it is none of LeRobot's, or a feature is too large.
    """
    try:
        found: dict[str, Any] = read_json(folder / INFO_FILE, Info, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{folder} is no dataset (there is no {INFO_FILE}); name one that was generated") from None
    if found["codebase_version"] in EARLIER_FORMATS:
        raise MemobenchError(
            f"{folder} is in LeRobot's format {found['codebase_version']}, and v3.0 is read; convert it in place, from "
            f"v2.1: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/converted "
            f"--root={shlex.quote(str(folder))} --push-to-hub=false"
        )
    for name, feature in found["features"].items():
        shape = feature.get("shape")
        sizes = [size for size in shape if isinstance(size, int)] if isinstance(shape, list) else []
        if abs(math.prod(sizes)) > MOST_NUMBERS:
            raise MemobenchError(
                f"{folder / INFO_FILE} has more than {MOST_NUMBERS:,} numbers of {name[:80]} per frame; {ADVICE}"
            )
    return found


def episode_count(folder: Path) -> int:
    """Return the number of episodes of the dataset in ``folder``, by ``meta/info.json`` and ``meta/episodes``.

    Raises:
        MemobenchError: they cannot be read, or disagree.
    """
    count, rows = int(read_info(folder)["total_episodes"]), _row_count(folder / "meta" / "episodes")
    if rows != count:
        raise MemobenchError(
            f"{folder / INFO_FILE} has {count_of(count, 'episode')}, {folder}/meta/episodes {rows}; {ADVICE}"
        )
    return count


def _row_count(folder: Path) -> int:
    """Return the number of rows of the tables in a folder, by their footers."""
    import pyarrow.parquet as pq

    rows = 0
    for path in sorted(folder.rglob("*.parquet")):
        with undamaged(path):
            rows += pq.read_metadata(path).num_rows
    return rows


class Asked(TypedDict):
    """An episode that was asked for."""

    task_name: str
    seed: Whole
    digest: NotRequired[str | None]


class Made(Asked):
    """An episode that is there."""

    failure: None
    frames: Count


class Failed(Asked):
    """One that is not, and why."""

    failure: str


class LeftOut(TypedDict):
    """A `Problem` of a conversion."""

    file: str
    group: str
    reason: str


class Written(TypedDict):
    """A file as it was written."""

    bytes: Count
    sha256: str


class Manifest(TypedDict):
    """``manifest.json``: the request of a run, and the hash of every episode and file."""

    episodes: list[Made | Failed]
    request: NotRequired[dict[str, Any]]
    left_out: NotRequired[list[LeftOut]]
    notes: NotRequired[list[LeftOut]]
    files: NotRequired[dict[str, Written]]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of the dataset in ``folder``.

    Raises:
        FileNotFoundError: there is none.
        MemobenchError: it is none of this package's.
    """
    found: dict[str, Any] = read_json(folder / MANIFEST_FILE, Manifest, NO_MANIFEST)
    return found


def without_pattern(folder: Path) -> Path:
    """Return a path of a dataset's folder for LeRobot, which takes names such as ``obj [v2]`` for patterns of `glob`.

    It is the folder itself, or a link to it in the cache: the same at every call, since LeRobot keeps a copy of the
    tables for each path.
    """
    place = str(folder.absolute())
    if glob.escape(place) == place or not folder.is_dir():
        return folder
    link = cache_folder() / "datasets" / hashlib.sha256(os.fsencode(place)).hexdigest()[:16]
    link.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        link.symlink_to(place)
    return link


# --- is it whole? ---


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """As `refusing`, for reading the dataset in ``folder``."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"), folder)


def check_whole(folder: Path) -> None:
    """Raise unless the dataset in ``folder`` has all of its frames, as far as that can be checked without reading them.

    Checked are the ends of tables and their numbers of rows, and the boxes of videos and their numbers of frames.

    Raises:
        MemobenchError: naming the first file that is cut off or gone, or what is missing of all.
    """
    info = read_info(folder)
    counts = {"data": info.get("total_frames"), "meta/episodes": info["total_episodes"]}
    if (folder / "states").is_dir():
        counts["states"] = info.get("total_frames")
    for part, expected in counts.items():
        rows = _row_count(folder / part)
        if expected is not None and rows != expected:
            raise MemobenchError(f"{folder / part} holds {rows} rows, {INFO_FILE} names {expected}; {ADVICE}")
    cameras = [key for key, feature in info["features"].items() if feature.get("dtype") == "video"]
    for path, frames in _video_lengths(folder, info, cameras).items():
        with undamaged(path):
            _check_video(path, frames)


def _video_lengths(folder: Path, info: dict[str, Any], cameras: list[str]) -> dict[Path, int]:
    """Return how many frames each video must have, from its last one in meta/episodes."""
    import pyarrow.parquet as pq

    found: dict[Path, int] = {}
    for table in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        for camera in cameras:
            parts = ("chunk_index", "file_index", "to_timestamp")
            with undamaged(table):
                columns = pq.read_table(table, columns=[f"videos/{camera}/{part}" for part in parts]).to_pydict()
                for chunk, file, end in zip(*columns.values(), strict=True):
                    place = info["video_path"].format(video_key=camera, chunk_index=int(chunk), file_index=int(file))
                    found[folder / place] = max(found.get(folder / place, 0), round(end * info["fps"]))
    return found


def _check_video(path: Path, frames: int) -> None:
    """Raise unless a video's boxes fill its file, and its header has at least so many frames."""
    import av

    check_fetched(path)
    size, place = path.stat().st_size, 0
    with path.open("rb") as file:
        while path.suffix == ".mp4" and place < size:
            file.seek(place)
            head = file.read(16)
            length = int.from_bytes(head[:4]) or size - place
            length = int.from_bytes(head[8:]) if length == 1 else length
            if length < 8 or place + length > size:
                raise MemobenchError(f"{path} is cut off or damaged at byte {place:,} of {size:,}; {ADVICE}")
            place += length
    with av.open(str(path)) as container:
        there = container.streams.video[0].frames
    if 0 < there < frames:
        raise MemobenchError(f"{path} has {there} frames, meta/episodes names {frames}; {ADVICE}")


def damaged_file(folder: Path) -> str | None:
    """Read all of a dataset; return a sentence that names the first file that cannot be, None where all can."""
    for name in (STATS_FILE, TASKS_FILE):
        if not (folder / name).is_file():
            return f"{folder / name} is missing; {ADVICE}"
    try:
        read_json(folder / STATS_FILE, dict[str, dict[str, Any]], ADVICE, nan=True)
    except MemobenchError as error:
        return str(error)
    tables = sorted([*folder.glob("data/**/*.parquet"), *folder.glob("meta/**/*.parquet")])
    for path in [*tables, *sorted(folder.glob("videos/**/*.mp4"))]:
        try:
            read_to_end(path)
        except MemobenchError as error:
            return str(error)
    return None


def read_to_end(path: Path) -> None:
    """Read all values of a table, or decode all pictures of a video.

    Raises:
        MemobenchError: one of them cannot be read.
    """
    import av
    import pyarrow.parquet as pq

    with undamaged(path):
        if path.suffix == ".parquet":
            pq.read_table(path)
            return
        _check_video(path, 0)
        with av.open(str(path)) as container:
            stream = container.streams.video[0]
            stream.codec_context.options = {"err_detect": "explode"}
            decoded = sum(1 for _ in container.decode(stream))
            if stream.frames and decoded != stream.frames:
                raise MemobenchError(f"{path} has {stream.frames} frames, and {decoded} can be decoded; {ADVICE}")


@contextmanager
def naming_damage(folder: Path | None) -> Iterator[None]:
    """Name the damaged file of a dataset where LeRobot's own error does not; None: no dataset is known.

    Raises:
        MemobenchError: in the place of such an error.
    """
    try:
        yield
    except MemobenchError:
        raise
    except Exception as error:
        names = [str(frame.f_globals.get("__name__")) for frame, _ in traceback.walk_tb(error.__traceback__)]
        reading = any(name.startswith(("lerobot.datasets.", "datasets.", "torch.utils.data.")) for name in names)
        if folder is None or not reading or not (folder / INFO_FILE).is_file():
            raise
        message = damaged_file(folder)
        if message is None:
            check_whole(folder)
            raise
        raise MemobenchError(message) from error
