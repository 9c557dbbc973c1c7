"""Read a dataset: its tables, the record of each episode, an episode's frames; find damaged files.

LeRobot's dataset tools may have edited it; the records are then read from the frames (`DemonstrationRecord`).
"""

from __future__ import annotations

import json
import shlex
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NotRequired, TypedDict

import numpy as np
from annotated_types import Ge, Le
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from lerobot_memobench.constants import CONTROL_HZ
from lerobot_memobench.datasets.demonstration import Demonstration, digest, key_frames
from lerobot_memobench.datasets.layout import (
    ADVICE,
    EPISODE_INFO,
    EPISODES,
    INFO_FILE,
    LANGUAGE,
    MANIFEST_FILE,
    STATS_FILE,
    TASKS_FILE,
    is_dataset,
)
from lerobot_memobench.envs.settings import STRICT_GOALS
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import files_below
from lerobot_memobench.tasks.catalogue import suite_of
from lerobot_memobench.tasks.task import STRICT
from lerobot_memobench.untrusted import (
    Count,
    Malformed,
    Number,
    Whole,
    check_fetched,
    checked,
    parsed,
    read_json,
    refusing,
)

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa

Filter = list[tuple[str, str, int]]  # column, comparison and number of the rows to read


def undamaged(folder: Path) -> AbstractContextManager[None]:
    """Turn errors of reading a dataset, or one of its files, into `MemobenchError` (`untrusted.refusing`)."""
    return refusing(lambda why: MemobenchError(f"{folder} cannot be read ({why}); {ADVICE}"), folder)


class Info(TypedDict):
    """``meta/info.json``. The number of episodes is bounded, because each is read."""

    codebase_version: str
    total_episodes: Annotated[int, Ge(0), Le(10_000_000)]
    total_frames: NotRequired[Count]
    fps: NotRequired[Annotated[int, Ge(1), Le(10_000)]]
    features: dict[str, dict[str, Any]]


def read_info(folder: Path) -> dict[str, Any]:
    """Return ``meta/info.json``; refuse a folder without it, damage, and other formats of LeRobot."""
    try:
        info: dict[str, Any] = read_json(folder / INFO_FILE, Info, ADVICE)
    except FileNotFoundError:
        raise MemobenchError(f"{folder} is no dataset (there is no {INFO_FILE}); name one that was generated") from None
    if not info["codebase_version"].startswith("v3."):
        raise MemobenchError(
            f"{folder} is in LeRobot's format {info['codebase_version']}, expected v3.0; convert it in place, from "
            f"v2.1: python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id=local/converted "
            f"--root={shlex.quote(str(folder))} --push-to-hub=false"
        )
    return info


def tables_of(
    folder: Path, wanted: Callable[[str], bool] = lambda _: True, rows: Filter | None = None
) -> Iterator[tuple[Path, pa.Table]]:
    """Yield each Parquet file of a folder and its table, with the ``wanted`` ones of its columns."""
    import pyarrow.parquet as pq

    files = files_below(folder, ".parquet")
    if not files:
        raise MemobenchError(f"{folder} holds no parquet file: the dataset is incomplete; fetch or generate it again")
    for path in files:
        with undamaged(path):
            names = [name for name in pq.read_schema(path).names if wanted(name)]
            table = pq.read_table(path, columns=names, filters=rows)
        yield path, table


def read_table(folder: Path, wanted: Callable[[str], bool] = lambda _: True, rows: Filter | None = None) -> pa.Table:
    """Return the tables of a folder as one (`tables_of`); columns that some files of merged datasets lack are null."""
    import pyarrow as pa

    return pa.concat_tables((table for _, table in tables_of(folder, wanted, rows)), promote_options="permissive")


def read_tasks(folder: Path) -> pd.DataFrame:
    """Return a dataset's instructions, the index, and their numbers, ``task_index``."""
    import pandas as pd

    with undamaged(folder / TASKS_FILE):
        check_fetched(folder / TASKS_FILE)
        return pd.read_parquet(folder / TASKS_FILE)


def is_numeric(kind: pa.DataType) -> bool:
    """Return whether a column holds numbers or flags, or lists of them."""
    import pyarrow.types as types

    while types.is_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind)


def numbers(column: pa.ChunkedArray) -> NDArray:
    """Return a column of numbers as (n,), or (n, d) if it holds lists of one length."""
    import pyarrow.types as types

    if not (types.is_list(column.type) or types.is_fixed_size_list(column.type)):
        return np.asarray(column.to_numpy())
    return np.asarray(column.combine_chunks().flatten().to_numpy(zero_copy_only=False)).reshape(len(column), -1)


def texts(column: pa.ChunkedArray) -> list[str]:
    """Return a column of texts. Rows are strings or lists of one string; a missing one is empty."""
    return [(value[0] if isinstance(value, list) else value) or "" for value in column.to_pylist()]


class DemonstrationRecord(BaseModel):
    """The facts of an episode as a whole: its task, seed, placement and hashes.

    A dataset stores it twice: in ``meta/episodes``, which ``LeRobotDataset(…, episode_filter=…)`` reads, and as JSON in
    the frames' column `EPISODE_INFO`, at each episode's first frame. LeRobot's dataset tools (``lerobot-edit-dataset``)
    keep the columns of frames, but drop unknown columns of ``meta/episodes`` and unknown files. Manifest and dataset
    card are made of it; a field's description is its meaning in the card.
    """

    model_config = ConfigDict(frozen=True)

    task_name: str = Field(description="task of the catalogue")
    memory_type: str = Field(description="temporal, spatial, object or procedural")
    family: str = Field(description="group of similar tasks")
    operations: str = Field(description="labels of the checkpoints in order, e.g. SUC")
    seed: Whole = Field(description="seed of the scene")  # -1 if unknown
    referent: str = Field(
        description="fixed; random: the demonstration prompt decides the goal; drawn: the seed decides it "
        "(strict tasks)"
    )
    variant: Count = Field(description="number of the referent or order; 0 is the published one")
    success: bool = Field(description="the goal was reached")
    exec_start_index: Count = Field(description="first frame of the execution")
    key_frames: list[Whole] = Field(description="frame at which each checkpoint was completed in order, −1 if never")
    goals: Count = Field(description="version of the goals of strict tasks; 0 for other tasks")
    scene_hash: str = Field(description="hash of the initial scene")
    fixture_poses: dict[str, list[Number]] = Field(description="JSON, fixture to position and quaternion wxyz")
    digest: str = Field(description="sha256 of states, actions and labels")
    world: Literal["libero"]
    stand_ins: list[str]  # classes whose missing scans this package's objects replaced
    versions: dict[str, str] | None = None  # of the packages on which the numbers depend

    @classmethod
    def meanings(cls) -> dict[str, str]:
        """Return the described fields and their descriptions."""
        return {name: field.description for name, field in cls.model_fields.items() if field.description}

    @classmethod
    def of(cls, demo: Demonstration) -> DemonstrationRecord:
        """Return the record of a demonstration, without ``versions``."""
        return cls(
            task_name=demo.task.name,
            memory_type=demo.task.memory_type,
            family=demo.task.family,
            operations=demo.task.operations,
            seed=int(demo.seed),
            referent=demo.referent,
            variant=int(demo.variant),
            success=bool(demo.success),
            exec_start_index=int(demo.exec_start),
            key_frames=key_frames(demo).tolist(),
            goals=goals_of(demo.task.name),
            scene_hash=demo.scene_hash,
            fixture_poses={name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()},
            digest=digest(demo),
            world="libero",
            stand_ins=list(demo.stand_ins),
        )

    def in_meta(self) -> dict[str, Any]:
        """Return the columns of ``meta/episodes``."""
        return self.model_dump(exclude={"versions"}) | {
            "key_frames": np.array(self.key_frames, dtype=np.int64),
            "fixture_poses": json.dumps(self.fixture_poses),
            "stand_ins": json.dumps(self.stand_ins),
        }


def goals_of(task_name: str) -> int:
    """Return the version of a strict task's goals in this version of the package; 0 for other tasks."""
    return STRICT_GOALS if suite_of(task_name) == STRICT else 0


def from_frames(text: str, where: str) -> DemonstrationRecord:
    """Return the record in the text of an episode's first frame; ``where`` names dataset and episode in errors."""
    try:
        record: DemonstrationRecord = checked(parsed(text), DemonstrationRecord)
    except Malformed as error:
        raise MemobenchError(
            f"{where}: its column {EPISODE_INFO} is not as this package writes it ({error}); take the dataset from its "
            "source again"
        ) from None
    return record


def from_meta(row: Mapping[str, Any]) -> DemonstrationRecord | None:
    """Return the record in a row of ``meta/episodes``; None if it is missing or incomplete."""
    try:
        in_json = {key: json.loads(row[key]) for key in ("fixture_poses", "stand_ins")}
        return DemonstrationRecord.model_validate({**row, **in_json})
    except (KeyError, ValueError, TypeError):
        return None


class FailedEpisode(TypedDict):
    """A requested episode that could not be made, and the reason."""

    task_name: str
    seed: Whole
    failure: str


class MadeEpisode(TypedDict):
    """A requested episode of the dataset."""

    task_name: str
    seed: Whole
    failure: None
    episode_index: Count
    frames: Count
    digest: str


class ConversionNote(BaseModel):
    """A group of a converted file ("": the file as a whole), and the reason why it was left out, or a note on it."""

    model_config = ConfigDict(frozen=True)

    file: str
    group: str
    reason: str

    def __str__(self) -> str:
        return f"{self.file}{', ' + self.group if self.group else ''}: {self.reason}"


class FileHash(TypedDict):
    """Size and hash of a file when it was written."""

    bytes: Count
    sha256: str


class Manifest(TypedDict):
    """``manifest.json``: the request of a run, and the hashes of its episodes and files."""

    episodes: list[MadeEpisode | FailedEpisode]
    request: NotRequired[dict[str, Any]]
    left_out: NotRequired[list[ConversionNote]]
    notes: NotRequired[list[ConversionNote]]
    files: NotRequired[dict[str, FileHash]]


def read_manifest(folder: Path) -> dict[str, Any]:
    """Return the manifest of a dataset, or raise FileNotFoundError."""
    advice = "this package did not write it like that; take the dataset from its source again"
    manifest: dict[str, Any] = read_json(folder / MANIFEST_FILE, Manifest, advice)
    return manifest


Columns = dict[str, Any]
STRANGER = (
    "it has neither task nor seed: another program made it, or LeRobot's tools edited a dataset without the column "
    f"{EPISODE_INFO} and dropped the fields of meta/episodes; generate it again"
)
"""Message for an episode without a record."""


@dataclass(frozen=True)
class ListedEpisode:
    """An episode of a dataset, without its frames."""

    index: int
    start: int  # first frame in the dataset's global index
    length: int
    record: DemonstrationRecord | None  # None if this package wrote none


def list_episodes(folder: Path) -> list[ListedEpisode]:
    """Return a dataset's episodes with their records, in order; refuse a record that is not this package's."""
    read_info(folder)
    rows = _rows(folder)
    own = ("episode_index", EPISODE_INFO)
    first = read_table(folder / "data", own.__contains__, [("frame_index", "==", 0)]).to_pylist()
    texts = {int(row["episode_index"]): row.get(EPISODE_INFO) for row in first}
    return [_listed(folder, row, texts.get(row["episode_index"])) for row in rows]


def episodes_where(folder: Path | str, **wanted: Any) -> list[int]:
    """Return the numbers of a dataset's episodes with all ``wanted`` fields, for LeRobot's ``episodes``.

    ``LeRobotDataset(…, episodes=episodes_where(folder, memory_type="spatial"))`` selects like LeRobot's
    ``episode_filter``, and also works after LeRobot's dataset tools have dropped the columns that the filter needs.

    Raises:
        MemobenchError: an unknown field (see `DemonstrationRecord`), or no such episode.
    """
    unknown = sorted(set(wanted) - set(DemonstrationRecord.model_fields))
    if unknown:
        raise MemobenchError(
            f"{unknown[0]!r} is no field of an episode; expected one of {', '.join(DemonstrationRecord.model_fields)}"
        )
    records = {episode.index: episode.record for episode in list_episodes(Path(folder)) if episode.record is not None}
    numbers = [n for n, record in records.items() if all(getattr(record, k) == v for k, v in wanted.items())]
    if not numbers:
        fields = ", ".join(f"{key}={value!r}" for key, value in wanted.items())
        raise MemobenchError(f"{folder} has no episode with {fields}; `memobench describe {folder}` lists them")
    return numbers


def check_suite_of(folder: Path, suite: str) -> None:
    """Refuse a LeRobotDataset with a task of another suite; tasks outside the catalogue belong to none."""
    for episode in list_episodes(folder) if is_dataset(folder) else ():
        name = episode.record.task_name if episode.record is not None else ""
        own = suite_of(name)
        if own not in (None, suite):
            raise MemobenchError(
                f"{folder} holds demonstrations of {short(name)}, a task of the {own} suite; use --suite {own}"
            )


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode of a dataset with its frames.

    Attributes:
        columns: values per frame; the column ``task`` is the instruction.
        start: first frame in the dataset's global index.
    """

    record: DemonstrationRecord
    columns: Columns
    start: int


def read_episode(root: Path | str, episode_index: int) -> RecordedEpisode:
    """Read an episode of a dataset that this package made; without states/, its columns lack ``states``."""
    root = Path(root)
    read_info(root)
    rows = _rows(root, episode_index)
    if len(rows) != 1:
        raise MemobenchError(f"{root} has no episode {episode_index}; see total_episodes in its meta/info.json")
    columns = _read_columns(root, episode_index)
    texts = columns.pop(EPISODE_INFO, [None])
    episode = _listed(root, rows[0], texts[0])
    record = episode.record
    if record is None:
        raise MemobenchError(STRANGER)
    _check_record(rows[0], record, texts, len(columns["frame_index"]))
    language = columns.get(LANGUAGE, [])
    changed = next((frame for frame, rows in enumerate(language) if rows != language[0]), None)
    if changed is not None:
        raise MemobenchError(f"{LANGUAGE} at frame {changed} differs from frame 0, expected equal rows in an episode")
    return RecordedEpisode(record, columns, episode.start)


def _check_record(row: dict[str, Any], record: DemonstrationRecord, texts: list[str | None], length: int) -> None:
    in_meta = from_meta(row)
    for key in DemonstrationRecord.model_fields if in_meta is not None else ():
        of_frames, of_meta = getattr(record, key), getattr(in_meta, key)
        if key != "versions" and of_frames != of_meta:
            raise MemobenchError(
                f"meta/episodes has {key}={short(of_meta)}, the frames' column {EPISODE_INFO} {short(of_frames)}"
            )
    again = next((frame for frame, text in enumerate(texts) if frame and text), None)
    if again is not None:
        raise MemobenchError(
            f"{EPISODE_INFO} at frame {again} is {short(texts[again])}, expected an empty text except at frame 0"
        )
    if row["length"] != length:
        raise MemobenchError(f"meta/episodes has length={row['length']}, but it has {length} frames")


def _rows(folder: Path, episode_index: int | None = None) -> list[dict[str, Any]]:
    """Return the rows of meta/episodes, or that of one episode, without statistics."""
    own = ("episode_index", "length", "dataset_from_index", *DemonstrationRecord.model_fields)
    chosen = None if episode_index is None else [("episode_index", "==", episode_index)]
    return read_table(folder / EPISODES, own.__contains__, chosen).sort_by("episode_index").to_pylist()


def _listed(folder: Path, row: dict[str, Any], text: str | None) -> ListedEpisode:
    number = int(row["episode_index"])
    record = from_frames(text, f"{folder}, episode {number}") if text else from_meta(row)
    if record is not None and record.goals != goals_of(record.task_name):
        raise MemobenchError(
            f"{folder}, episode {number}: the goal of {record.task_name} has version {record.goals}, expected "
            f"{goals_of(record.task_name)}; generate the demonstrations again"
        )
    return ListedEpisode(number, int(row["dataset_from_index"]), int(row["length"]), record)


def _read_columns(root: Path, episode_index: int) -> Columns:
    chosen = [("episode_index", "==", episode_index)]
    table = read_table(root / "data", rows=chosen).sort_by("frame_index")
    columns: Columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        columns[name] = np.array(numbers(column)) if is_numeric(column.type) else column.to_pylist()
    tasks = read_tasks(root)
    names = {index(number): str(text) for text, number in zip(tasks.index, tasks["task_index"].tolist(), strict=True)}
    columns["task"] = [names.get(int(number), "") for number in columns.pop("task_index")]
    if (root / "states").is_dir():
        states = read_table(root / "states", rows=chosen).sort_by("frame_index")
        columns["states"] = numbers(states.column("state"))
    return columns


EPISODES_FILE = EPISODES + "/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
PLACES = ("index", "timestamp", "length", "tasks")  # ends of the names of columns that place episodes and frames
TOLERANCE = 1e-3  # largest difference of times, s or frames


def check_whole(folder: Path) -> None:
    """Check that a dataset has all of its frames, at the places that its metadata names, without decoding videos.

    The check covers ends and row counts of tables, totals, numbers of tasks, bounds and files of episodes, the
    numbering of frames, and boxes and frame counts of videos. The error names the first truncated or missing file, or
    the first number that differs.
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
    expect(EPISODES, "tasks", [set(names) for names in rows["tasks"]], texts)
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


def expect(where: Path | str, key: str, values: Any, wanted: Any) -> None:
    """Raise `MemobenchError` at the first difference of two sequences of numbers, texts or sets."""
    values, wanted = np.asarray(values), np.asarray(wanted)
    if values.shape == wanted.shape:
        is_number = wanted.dtype.kind in "iuf"
        differs = np.flatnonzero(~(abs(values - wanted) <= TOLERANCE) if is_number else values != wanted)
        if not differs.size:
            return
        values, wanted, key = values[differs[:1]], wanted[differs[:1]], f"{key} of row {differs[0]}"
    raise MemobenchError(f"{where}: {key} is {short(values.tolist())}, expected {short(wanted.tolist())}; {ADVICE}")


def _table(folder: Path, part: str) -> pd.DataFrame:
    """Return numbering and bounds in a folder's tables, and the file of each row as ``path``."""
    import pandas as pd

    tables = [
        table.to_pandas().assign(path=path.relative_to(folder).as_posix())
        for path, table in tables_of(folder / part, lambda name: name.endswith(PLACES))
    ]
    return pd.concat(tables, ignore_index=True)


def _paths(template: str, rows: pd.DataFrame, prefix: str) -> NDArray:
    numbers = zip(rows[f"{prefix}/chunk_index"], rows[f"{prefix}/file_index"], strict=True)
    return np.array([template.format(chunk_index=int(chunk), file_index=int(file)) for chunk, file in numbers])


def _check_video(path: Path, frames: int) -> None:
    """Raise unless a video's boxes fill its file, and its header states at least ``frames`` frames."""
    import av

    check_fetched(path)
    size, start = path.stat().st_size, 0
    with path.open("rb") as file:
        while path.suffix == ".mp4" and start < size:
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4]) or size - start  # 0: to the end of the file; 1: in the next 8 bytes
            length = int.from_bytes(head[8:]) if length == 1 else length
            if length < 8 or start + length > size:
                raise MemobenchError(f"{path} is cut off or damaged at byte {start:,} of {size:,}; {ADVICE}")
            start += length
    with av.open(str(path)) as container:
        stated = container.streams.video[0].frames
    if 0 < stated < frames:
        raise MemobenchError(f"{path} has {stated} frames, meta/episodes names {frames}; {ADVICE}")


def read_to_end(path: Path) -> None:
    """Read a JSON file, all values of a table, or all frames of a video."""
    import av
    import pyarrow.parquet as pq

    with undamaged(path):
        if path.suffix == ".json":
            read_json(path, dict[str, Any], ADVICE, nan=True)
            return
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

    Errors pass if ``folder`` is None, for a dataset that is not on this disk.
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
        files = [path for part in ("data", "meta", "videos") for path in files_below(folder / part, ".parquet", ".mp4")]
        try:
            for path in (folder / STATS_FILE, folder / TASKS_FILE, *files):
                if not path.is_file():
                    raise MemobenchError(f"{path} is missing; {ADVICE}")
                read_to_end(path)
            check_whole(folder)
        except MemobenchError as damage:
            raise damage from error
        raise
