"""What LeRobot keeps of a dataset in ``meta/info.json``, as far as it is used here; and reading what may be damaged."""

from __future__ import annotations

import math
import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

from annotated_types import Ge, Le

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, count_of, read_json, refusing

INFO_FILE = Path("meta") / "info.json"
ADVICE = "the dataset is damaged; generate it or take it from its source again"
MOST_NUMBERS = 50_000_000
"""Of a feature in one frame: a picture of 4096 x 4096. LeRobot takes memory for as many as a dataset tells."""


class Info(TypedDict):
    """A dataset as a whole. Each of its episodes is looked at, so their number is no arbitrary one."""

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
    for name, feature in found["features"].items():
        shape = feature.get("shape")
        sizes = [size for size in shape if isinstance(size, int)] if isinstance(shape, list) else []
        if abs(math.prod(sizes)) > MOST_NUMBERS:
            raise MemobenchError(
                f"{folder / INFO_FILE} tells of more than {MOST_NUMBERS:,} numbers of {name[:80]} a frame; {ADVICE}"
            )
    return found


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """As `refusing`, for reading the dataset in ``folder``."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"))


def check_whole(folder: Path) -> None:
    """Raise unless the dataset in ``folder`` has all of its frames, as far as that can be told without reading them.

    Looked at are the ends of tables and their numbers of rows, and the boxes of videos and their numbers of frames.

    Raises:
        MemobenchError: naming the first file that is cut off or gone, or what is missing of all.
    """
    import pyarrow.parquet as pq

    info = read_info(folder)
    counts = {"data": info.get("total_frames"), "meta/episodes": info["total_episodes"]}
    if (folder / "states").is_dir():
        counts["states"] = info.get("total_frames")
    for part, expected in counts.items():
        rows = 0
        for path in sorted((folder / part).rglob("*.parquet")):
            with undamaged(path):
                rows += pq.read_metadata(path).num_rows
        if expected is not None and rows != expected:
            raise MemobenchError(f"{folder / part} holds {rows} rows, {INFO_FILE} tells of {expected}; {ADVICE}")
    cameras = [key for key, feature in info["features"].items() if feature.get("dtype") == "video"]
    for path, frames in _video_lengths(folder, info, cameras).items():
        with undamaged(path):
            _check_video(path, frames)


def _video_lengths(folder: Path, info: dict[str, Any], cameras: list[str]) -> dict[Path, int]:
    """Return how many frames each video must have, as meta/episodes tells of its last one."""
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
    """Raise unless a video's boxes fill its file, and it tells of at least so many frames."""
    import av

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
        raise MemobenchError(f"{path} has {there} frames, meta/episodes tells of {frames}; {ADVICE}")


def damaged_file(folder: Path) -> str | None:
    """Read all of a dataset; return a sentence that names the first file that cannot be, None where all can."""
    import av
    import pyarrow.parquet as pq

    for path in sorted([*folder.glob("data/**/*.parquet"), *folder.glob("meta/**/*.parquet")]):
        try:
            with undamaged(path):
                pq.read_table(path)
        except MemobenchError as error:
            return str(error)
    for path in sorted(folder.glob("videos/**/*.mp4")):
        try:
            with undamaged(path):
                _check_video(path, 0)
                with av.open(str(path)) as container:
                    container.streams.video[0].codec_context.options = {"err_detect": "explode"}
                    for _ in container.decode(video=0):
                        pass
        except MemobenchError as error:
            return str(error)
    return None


@contextmanager
def naming_damage(folder: Path | None) -> Iterator[None]:
    """Name the damaged file of a dataset, where LeRobot reads it and its error does not; None: nothing is known of it.

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
        told = damaged_file(folder)
        if told is None:
            check_whole(folder)
            raise
        raise MemobenchError(told) from error


def episode_count(folder: Path) -> int:
    """Return how many episodes the dataset in ``folder`` has, as ``meta/info.json`` and ``meta/episodes`` both say.

    Raises:
        MemobenchError: they cannot be read, or disagree.
    """
    import pyarrow.parquet as pq

    told = int(read_info(folder)["total_episodes"])
    rows = 0
    for path in sorted((folder / "meta" / "episodes").rglob("*.parquet")):
        with undamaged(path):
            rows += pq.read_metadata(path).num_rows
    if rows != told:
        raise MemobenchError(
            f"{folder / INFO_FILE} tells of {count_of(told, 'episode')}, {folder}/meta/episodes of {rows}; {ADVICE}"
        )
    return told
