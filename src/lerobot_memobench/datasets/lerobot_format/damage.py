"""Find missing, truncated and damaged files of a dataset."""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.lerobot_format.layout import ADVICE, EPISODES, INFO_FILE, STATS_FILE, TASKS_FILE
from lerobot_memobench.datasets.lerobot_format.tables import read_info, read_tasks, tables_of, undamaged
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import check_fetched, files_below, read_json, short
from lerobot_memobench.protocol import CONTROL_HZ

if TYPE_CHECKING:
    import pandas as pd

EPISODES_FILE = EPISODES + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACES = ("index", "timestamp", "length", "tasks")
"""Ends of the names of columns that place episodes and frames."""
TOLERANCE = 1e-3
"""Largest difference of times, s or frames."""


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
    rows, frames, tasks = _table(folder, EPISODES), _table(folder, "data"), read_tasks(folder)
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

    tables = [
        table.to_pandas().assign(path=path.relative_to(folder).as_posix())
        for path, table in tables_of(folder / part, lambda name: name.endswith(PLACES))
    ]
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


def read_all(folder: Path) -> None:
    """Read a whole dataset to its end.

    Raises:
        MemobenchError: naming the first file that is missing or cannot be read.
    """
    tables = [path for part in ("data", "meta") for path in files_below(folder / part, ".parquet")]
    for path in [folder / STATS_FILE, folder / TASKS_FILE, *tables, *files_below(folder / "videos", ".mp4")]:
        if not path.is_file():
            raise MemobenchError(f"{path} is missing; {ADVICE}")
        if path.suffix == ".json":
            read_json(path, dict[str, dict[str, Any]], ADVICE, nan=True)
        else:
            read_to_end(path)


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
        try:
            read_all(folder)
            check_whole(folder)
        except MemobenchError as damage:
            raise damage from error
        raise
