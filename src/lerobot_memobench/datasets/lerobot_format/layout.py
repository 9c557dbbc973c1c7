"""Layout of a dataset's folder: names of files and columns, metadata, and checks for missing or damaged files."""

from __future__ import annotations

import glob
import hashlib
import os
import shlex
import traceback
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NotRequired, TypedDict

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict

from lerobot_memobench.datasets.demonstration import (
    HELD_COLUMN,
    INSTRUCTION_COLUMN,
    LEVEL_COLUMNS,
    MAX_CHECKPOINTS,
    MEMORY_COLUMN,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import (
    Count,
    Whole,
    cache_folder,
    check_fetched,
    count_of,
    files_below,
    read_json,
    refuse_links,
    refusing,
    short,
)
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, CLOCK, CONTROL_HZ, PROPRIO_DIM
from lerobot_memobench.sim.convention import MIRRORED

if TYPE_CHECKING:
    import pandas as pd

STAGING = ".staging"
"""Folder of an unfinished run within its destination."""
DEFAULT_REPO_ID = "memobench/memobench"
MANIFEST_FILE = "manifest.json"
INFO_FILE = Path("meta") / "info.json"
STATS_FILE = Path("meta") / "stats.json"
TASKS_FILE = Path("meta") / "tasks.parquet"
EPISODES = "meta/episodes"
EPISODES_FILE = EPISODES + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACES = ("index", "timestamp", "length", "tasks")
"""Ends of the names of columns that place episodes and frames."""
TOLERANCE = 1e-3
"""Largest difference of times, s or frames."""
TOP_LEVEL = ("videos", "states", "data", "README.md", MANIFEST_FILE, "meta")
"""In the order in which they are moved into place; with `meta` the folder becomes a dataset."""
EPISODE_INFO = "episode_info"
"""Column of frames with the episode's record at its first frame, empty elsewhere."""
LANGUAGE = "language_persistent"
"""LeRobot's column of language rows."""
OBJECTS = "observation.environment_state"
"""Column of visible objects in datasets without images; LeRobot uses a column of this name as an input."""
PRIVILEGED = "privileged.environment_state"
"""The same in datasets with images, so that LeRobot's own commands do not train on object poses there."""
EXECUTED_ACTION = "executed_action"
"""The action that moved the arm; `action` is the expert's, which differs in perturbed episodes. LeRobot learns every
column whose name begins with `action`, so this name does not."""
PROPRIO_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"]
ACTION_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper"]
ADVICE = "the dataset is damaged; generate it or take it from its source again"
NO_MANIFEST = "this package did not write it like that; take the dataset from its source again"


def is_dataset(folder: Path) -> bool:
    """Return whether ``folder`` holds a finished LeRobotDataset."""
    return (folder / INFO_FILE).is_file()


def check_destination(out: Path) -> None:
    """Raise unless ``out`` is absent, empty, or holds only an unfinished run."""
    if is_dataset(out):
        raise MemobenchError(f"{out} already holds a finished dataset; name another folder or delete this one first")
    if ":" in str(out) and not out.is_absolute():
        raise MemobenchError(f"{out} contains a colon, which Arrow reads as an address; use an absolute path")
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file, expected a folder to write a dataset to; name another path")
    refuse_links(*(out / name for name in (STAGING, *TOP_LEVEL)))
    # Files of an interrupted move next to the staging folder are replaced.
    strangers = [p.name for p in out.iterdir() if p.name != STAGING] if out.is_dir() else []
    if strangers and not ((out / STAGING).is_dir() and set(strangers) <= set(TOP_LEVEL)):
        raise MemobenchError(
            f"{out} holds {', '.join(sorted(strangers)[:3])}, no part of a dataset being made; name an empty folder"
        )


def dataset_files(folder: Path) -> list[str]:
    """Return the paths of a dataset's files below ``folder``, without card, manifest and caches."""
    folders = [folder / name for name in TOP_LEVEL if not Path(name).suffix]
    return sorted(path.relative_to(folder).as_posix() for part in folders for path in files_below(part))


# --- columns ---


def image_key(camera: str) -> str:
    """Return the column name of a camera, which is also the name of its observation."""
    return f"observation.images.{camera}"


def objects_column(names: Collection[str]) -> str:
    """Return the column of objects among ``names``; datasets with images of earlier versions use LeRobot's name."""
    return PRIVILEGED if PRIVILEGED in names else OBJECTS


def check_clock(names: Collection[str], where: Path | str) -> None:
    """Refuse a dataset of an earlier version, whose prompts would be read as execution.

    Args:
        names: its columns.
        where: its folder.

    Raises:
        MemobenchError: it has the column ``phase`` of that version instead of the present ones.
    """
    if {"phase", "simple_subgoal"} <= set(names) and not set(CLOCK) <= set(names):
        raise MemobenchError(
            f"{where} was made by an earlier version: it has the column phase instead of {' and '.join(CLOCK)}; "
            "generate or convert it again"
        )


def dataset_features(
    image_size: tuple[int, int] | None, cameras: Collection[str] = tuple(CAMERAS)
) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns; ``image_size`` is (height, width), None without images."""
    from lerobot_memobench.sim.object_layout import NAMES, SIZE

    def feature(dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": shape, "names": names}

    features: dict[str, dict[str, Any]] = {}
    stated = {} if {*cameras} == {*CAMERAS} else {"convention": MIRRORED}  # LeRobot merges equal descriptions alone
    if image_size is not None:
        for camera in cameras:
            features[image_key(camera)] = feature("video", (*image_size, 3), ["height", "width", "channels"]) | stated
    features[OBJECTS if image_size is None else PRIVILEGED] = feature("float32", (SIZE,), NAMES)
    completed = [f"checkpoint_{k}" for k in range(MAX_CHECKPOINTS)]
    return features | {
        "observation.state": feature("float32", (PROPRIO_DIM,), PROPRIO_NAMES),
        "action": feature("float32", (ACTION_DIM,), ACTION_NAMES),
        EXECUTED_ACTION: feature("float32", (ACTION_DIM,), ACTION_NAMES),
        **{name: feature("float32", names=[name.rpartition(".")[2]]) for name in CLOCK},
        HELD_COLUMN: feature("bool", names=["action_has_no_effect"]),
        "checkpoint.index": feature("int64", names=["completed_in_order"]),
        "checkpoint.operation": feature("int64", names=["0_storage_1_update_2_compression_-1_none"]),
        "checkpoint.completed": feature("bool", (MAX_CHECKPOINTS,), completed),
        "checkpoint.event": feature("bool", names=["satisfied_first"]),
        **dict.fromkeys((*LEVEL_COLUMNS.values(), INSTRUCTION_COLUMN, MEMORY_COLUMN), feature("string")),
        "language_persistent": feature("language"),
        EPISODE_INFO: feature("string"),
    }


# --- metadata ---


class Info(TypedDict):
    """``meta/info.json``. The number of episodes is bounded, because each is read."""

    codebase_version: str
    total_episodes: Annotated[int, Ge(0), Le(10_000_000)]
    total_frames: NotRequired[Count]
    fps: NotRequired[Annotated[int, Ge(1), Le(10_000)]]
    features: dict[str, dict[str, Any]]


def read_info(folder: Path) -> dict[str, Any]:
    """Return ``meta/info.json`` of the dataset in ``folder``.

    Raises:
        MemobenchError: there is none, it is damaged, or of an earlier format.
    """
    try:
        found: dict[str, Any] = read_json(folder / INFO_FILE, Info, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{folder} is no dataset (there is no {INFO_FILE}); name one that was generated") from None
    if not found["codebase_version"].startswith("v3."):
        raise MemobenchError(
            f"{folder} is in LeRobot's format {found['codebase_version']}, expected v3.0; convert it in place, from "
            f"v2.1: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/converted "
            f"--root={shlex.quote(str(folder))} --push-to-hub=false"
        )
    return found


def episode_count(folder: Path) -> int:
    """Return the number of episodes of the dataset in ``folder``, by ``meta/info.json`` and ``meta/episodes``.

    Raises:
        MemobenchError: they cannot be read, or disagree.
    """
    count, rows = int(read_info(folder)["total_episodes"]), len(_table(folder, EPISODES))
    if rows != count:
        raise MemobenchError(
            f"{folder / INFO_FILE} has {count_of(count, 'episode')}, {folder}/meta/episodes {rows}; {ADVICE}"
        )
    return count


class Asked(TypedDict):
    """A requested episode."""

    task_name: str
    seed: Whole
    digest: NotRequired[str | None]


class Made(Asked):
    """An episode of the dataset."""

    failure: None
    frames: Count


class Failed(Asked):
    """An episode that could not be made, and the reason."""

    failure: str


class Problem(BaseModel):
    """A part of a converted file, and the reason why it was left out, or a note on it.

    Attributes:
        group: group of the file, "" for the file as a whole.
    """

    model_config = ConfigDict(frozen=True)

    file: str
    group: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}{', ' + self.group if self.group else ''}: {self.reason}"


class Written(TypedDict):
    """Size and hash of a file when it was written."""

    bytes: Count
    sha256: str


class Manifest(TypedDict):
    """``manifest.json``: the request of a run, and the hash of every episode and file."""

    episodes: list[Made | Failed]
    request: NotRequired[dict[str, Any]]
    left_out: NotRequired[list[Problem]]
    notes: NotRequired[list[Problem]]
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


# --- damage ---


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """Turn errors of reading the dataset in ``folder``, or one of its files, into `MemobenchError` (`io.refusing`)."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"), folder)


def check_whole(folder: Path) -> None:
    """Check that a dataset has all of its frames, at the places that its metadata names, without decoding videos.

    The check covers ends and row counts of tables, totals, numbers of tasks, bounds and files of episodes, the
    numbering of frames, and boxes and frame counts of videos.

    Raises:
        MemobenchError: naming the first truncated or missing file, or the first number that differs.
    """
    with undamaged(folder):
        _check_bounds(folder, read_info(folder))


def _check_bounds(folder: Path, info: dict[str, Any]) -> None:
    import pandas as pd

    check_fetched(folder / TASKS_FILE)
    rows, frames, tasks = _table(folder, EPISODES), _table(folder, "data"), pd.read_parquet(folder / TASKS_FILE)
    totals = {"total_episodes": len(rows), "total_frames": len(frames), "total_tasks": len(tasks)}
    for key, total in totals.items():
        expect(INFO_FILE, key, [info.get(key, total)], [total])
    if (folder / "states").is_dir():
        expect("states", "number of rows", [len(_table(folder, "states"))], [len(frames)])
    expect(TASKS_FILE, "task_index", tasks["task_index"], range(len(tasks)))
    episodes = np.arange(len(rows))
    lengths = frames["episode_index"].value_counts().reindex(episodes, fill_value=0).to_numpy()
    ends, of_frame = np.cumsum(lengths), np.repeat(episodes, lengths)
    starts, index = ends - lengths, np.arange(len(of_frame))
    within = index - starts[of_frame]
    bounds = {"episode_index": episodes, "length": lengths, "dataset_from_index": starts, "dataset_to_index": ends}
    for key, wanted in bounds.items():
        expect(EPISODES, key, rows[key], wanted)
    times = within / info.get("fps", CONTROL_HZ)
    numbers = {"episode_index": of_frame, "index": index, "frame_index": within, "timestamp": times}
    files = _paths(EPISODES_FILE, rows, EPISODES) if f"{EPISODES}/file_index" in rows else rows["path"]
    expect(EPISODES, "file", files, rows["path"])
    for key, wanted in (numbers | {"path": _paths(info["data_path"], rows, "data")[of_frame]}).items():
        expect("data", key, frames[key], wanted)
    texts = [{tasks.index[k] for k in set(part)} for part in np.split(frames["task_index"].to_numpy(), ends[:-1])]
    expect(EPISODES, "tasks", [set(each) for each in rows["tasks"]], texts)
    for camera in (key for key, feature in info["features"].items() if feature["dtype"] == "video"):
        times = rows[[f"videos/{camera}/from_timestamp", f"videos/{camera}/to_timestamp"]].to_numpy() * info["fps"]
        expect(EPISODES, f"length of {camera}", np.diff(times)[:, 0], rows["length"])
        paths = _paths(info["video_path"].replace("{video_key}", camera), rows, f"videos/{camera}")
        for path in dict.fromkeys(paths):
            begins, stops = times[paths == path].T
            if not (folder / path).is_file() or (begins < np.append(0, stops[:-1]) - TOLERANCE).any():
                raise MemobenchError(f"{EPISODES} names {path}, which is missing, or where episodes overlap; {ADVICE}")
            with undamaged(folder / path):
                _check_video(folder / path, round(stops[-1]))


def expect(where: Path | str, key: str, found: Any, wanted: Any) -> None:
    """Raise `MemobenchError` at the first difference of two sequences of numbers, texts or sets."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    if found.shape == wanted.shape:
        is_number = wanted.dtype.kind in "iuf"
        differs = np.flatnonzero(~(abs(found - wanted) <= TOLERANCE) if is_number else found != wanted)
        if not differs.size:
            return
        found, wanted, key = found[differs[:1]], wanted[differs[:1]], f"{key} of row {differs[0]}"
    raise MemobenchError(f"{where}: {key} is {short(found.tolist())}, expected {short(wanted.tolist())}; {ADVICE}")


def _table(folder: Path, part: str) -> pd.DataFrame:
    """Return numbering and bounds in a folder's tables, and the file of each row as ``path``."""
    import pandas as pd
    import pyarrow.parquet as pq

    tables = []
    for path in files_below(folder / part, ".parquet"):
        with undamaged(path):
            names = [name for name in pq.read_schema(path).names if name.endswith(PLACES)]
            table = pq.read_table(path, columns=names).to_pandas()
        tables.append(table.assign(path=path.relative_to(folder).as_posix()))
    if not tables:
        raise MemobenchError(f"{folder / part} holds no table; {ADVICE}")
    return pd.concat(tables, ignore_index=True)


def _paths(template: str, rows: pd.DataFrame, prefix: str) -> NDArray:
    """Return the file of each episode by its numbers in meta/episodes."""
    numbers = zip(rows[f"{prefix}/chunk_index"], rows[f"{prefix}/file_index"], strict=True)
    return np.array([template.format(chunk_index=int(chunk), file_index=int(file)) for chunk, file in numbers])


def _check_video(path: Path, frames: int) -> None:
    """Raise unless a video's boxes fill its file, and its header states at least ``frames`` frames."""
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
    """Read a whole dataset; return a message that names the first unreadable file, None if all can be read."""
    tables = [path for part in ("data", "meta") for path in files_below(folder / part, ".parquet")]
    for path in [folder / STATS_FILE, folder / TASKS_FILE, *tables, *files_below(folder / "videos", ".mp4")]:
        try:
            if not path.is_file():
                return f"{path} is missing; {ADVICE}"
            if path.suffix == ".json":
                read_json(path, dict[str, dict[str, Any]], ADVICE, nan=True)
            else:
                read_to_end(path)
        except MemobenchError as error:
            return str(error)
    return None


def read_to_end(path: Path) -> None:
    """Read all values of a table, or decode all frames of a video.

    Raises:
        MemobenchError: a part of it cannot be read.
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
                raise MemobenchError(f"{path} has {stream.frames} frames, but only {decoded} can be decoded; {ADVICE}")


@contextmanager
def naming_damage(folder: Path | None) -> Iterator[None]:
    """Replace an error of LeRobot in reading a dataset by a `MemobenchError` that names the damaged file.

    Args:
        folder: the dataset; None if it is unknown, then errors pass.
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
