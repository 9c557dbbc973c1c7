"""Read a dataset of this package back: the record of each episode, and an episode's frames.

LeRobot's dataset tools may have edited it since; what they leave is read from the frames (`record.EpisodeRecord`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.datasets.lerobot_format.layout import (
    EPISODE_INFO,
    EXECUTED_ACTION,
    LANGUAGE,
    OBJECTS,
    PRIVILEGED,
    is_dataset,
    undamaged,
)
from lerobot_memobench.datasets.lerobot_format.record import EpisodeRecord, from_frames, from_meta
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, suite_of
from lerobot_memobench.tasks.task import MEMOBENCH, STRICT, World

if TYPE_CHECKING:
    import pyarrow as pa

Columns = dict[str, Any]
STRANGER = (
    "it has neither task nor seed: another program made it, or LeRobot's tools edited a dataset that was written "
    f"before its frames had the column {EPISODE_INFO}, and dropped the fields of meta/episodes; generate it again"
)
"""Message on an episode without a record."""
WHOLE = {
    "memory_type",
    "family",
    "operations",
    "success",
    "key_frames",
    "scene_hash",
    "fixture_poses",
    "digest",
}
"""Fields of a record that follow from task, seed and actions."""


@dataclass(frozen=True)
class EpisodePlace:
    """An episode in a dataset.

    Attributes:
        index: its number in the dataset.
        start: its first frame in the dataset's global index.
        length: frames.
        record: None where this package wrote none.
        instructions: of its frames, each once.
    """

    index: int
    start: int
    length: int
    record: EpisodeRecord | None
    instructions: tuple[str, ...] = ()


def list_episodes(folder: Path) -> list[EpisodePlace]:
    """Return each of a dataset's episodes with its record, in their order.

    Raises:
        MemobenchError: the folder is no dataset, or a record in it is damaged.
    """
    _check(folder)
    rows = _rows(folder)
    first = _read(folder / "data", ("episode_index", EPISODE_INFO), [("frame_index", "==", 0)]).to_pylist()
    texts = {int(row["episode_index"]): row.get(EPISODE_INFO) for row in first}
    return [_place(folder, row, texts.get(row["episode_index"])) for row in rows]


def episodes_where(folder: Path | str, **wanted: Any) -> list[int]:
    """Return the numbers of a dataset's episodes with all ``wanted`` fields, for LeRobot's ``episodes``.

    ``LeRobotDataset(…, episodes=episodes_where(folder, memory_type="spatial"))`` is what LeRobot's ``episode_filter``
    does, also after LeRobot's dataset tools have dropped the columns that such a filter needs.

    Raises:
        MemobenchError: a word that a record (`EpisodeRecord`) does not have, or no such episode.
    """
    unknown = sorted(set(wanted) - set(EpisodeRecord.model_fields))
    if unknown:
        raise MemobenchError(f"found {unknown[0]!r}, expected one of {', '.join(EpisodeRecord.model_fields)}")
    records = {place.index: place.record for place in list_episodes(Path(folder)) if place.record is not None}
    found = [n for n, record in records.items() if all(getattr(record, k) == v for k, v in wanted.items())]
    if not found:
        asked = ", ".join(f"{key}={value!r}" for key, value in wanted.items())
        raise MemobenchError(f"{folder} has no episode with {asked}; `memobench describe {folder}` lists them")
    return found


def check_suite_of(folder: Path, suite: str) -> None:
    """Refuse a LeRobotDataset that holds a task of another suite; tasks outside the catalogue belong to none.

    Raises:
        MemobenchError: naming the first such task.
    """
    for place in list_episodes(folder) if is_dataset(folder) else ():
        name = place.record.task_name if place.record is not None else ""
        found = suite_of(name)
        if found not in (None, suite):
            raise MemobenchError(
                f"{folder} holds demonstrations of {name!r}, a task of the {found} suite; say --suite {found}"
            )


def check_idling(folder: Path, places: Iterable[EpisodePlace] | None = None) -> None:
    """Refuse a LeRobotDataset with strict demonstrations of earlier goals, or from before the robot idled.

    Args:
        places: its episodes; None: they are listed.

    Raises:
        MemobenchError: naming the first such episode.
    """
    for place in list_episodes(folder) if places is None else places:
        record = place.record
        if record is None or record.seed < 0 or suite_of(record.task_name) != STRICT:
            continue
        from lerobot_memobench.envs.episode import first_execution_step

        task, found = get_task(record.task_name), record.exec_start_index
        asked = task.variant(record.variant).language
        if place.instructions and asked not in place.instructions:
            raise MemobenchError(
                f"episode {place.index} of {folder} ({record.task_name}, seed {record.seed}) has the instruction "
                f"{place.instructions[0]!r}, and this version {asked!r}: the goals of strict tasks have changed; "
                "generate the demonstrations again"
            )
        begins = [first_execution_step(task, record.seed, prompt) for prompt in (True, False)]
        if found not in begins:
            raise MemobenchError(
                f"episode {place.index} of {folder} ({record.task_name}, seed {record.seed}) begins its execution at "
                f"step {found} and not, as now, at {begins[0]}: strict demonstrations from before the robot idled show "
                "by the step how much is done; generate them again"
            )


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode of a dataset on disk: ``columns`` per frame and ``whole``, the fields of the episode.

    The instruction of each frame is the column ``task``; ``start`` is the first frame in the dataset's global index.
    """

    task_name: str
    variant: int
    seed: int
    referent: str
    exec_start: int
    columns: Columns
    whole: dict[str, Any]
    start: int = 0
    world: World = MEMOBENCH


def read_episode(root: Path | str, episode_index: int) -> RecordedEpisode:
    """Read an episode of a dataset that this package made; without states/, its columns lack ``states``.

    Raises:
        MemobenchError: no dataset, no such episode, or one that this package did not make.
    """
    root = Path(root)
    _check(root)
    rows = _rows(root, episode_index)
    if len(rows) != 1:
        raise MemobenchError(f"{root} has no episode {episode_index}; see total_episodes in its meta/info.json")
    columns = _read_columns(root, episode_index)
    texts = columns.pop(EPISODE_INFO, [None])
    place = _place(root, rows[0], texts[0])
    record = place.record
    if record is None:
        raise MemobenchError(STRANGER)
    _check_record(rows[0], record, texts, len(columns["frame_index"]))
    fields = record.model_dump(include=WHOLE)
    whole = {key: value for key, value in fields.items() if value not in (None, "")}
    if LANGUAGE in columns:
        whole[LANGUAGE] = columns[LANGUAGE][0]
        changed = next((frame for frame, rows in enumerate(columns[LANGUAGE]) if rows != whole[LANGUAGE]), None)
        if changed is not None:
            raise MemobenchError(f"{LANGUAGE} at frame {changed} is another than at frame 0, expected one per episode")
    _name_tasks(root, columns)
    return RecordedEpisode(
        record.task_name,
        record.variant,
        record.seed,
        record.referent,
        record.exec_start_index,
        columns,
        whole,
        place.start,
        record.world or MEMOBENCH,
    )


def _check_record(row: dict[str, Any], record: EpisodeRecord, texts: list[str | None], length: int) -> None:
    """Raise where the two records of an episode, or its frames, contradict each other."""
    in_meta = from_meta(row)
    for key in EpisodeRecord.model_fields if in_meta is not None else ():
        here, there = getattr(record, key), getattr(in_meta, key)
        if key != "versions" and here != there:
            raise MemobenchError(f"meta/episodes has {key}={there!r}, the frames' column {EPISODE_INFO} {here!r}")
    again = next((frame for frame, text in enumerate(texts) if frame and text), None)
    if again is not None:
        raise MemobenchError(f"{EPISODE_INFO} at frame {again} is {texts[again]!r}, expected nothing but at frame 0")
    if row["length"] != length:
        raise MemobenchError(f"meta/episodes has length={row['length']}, but it has {length} frames")


def _name_tasks(root: Path, columns: Columns) -> None:
    """Put each frame's instruction, as ``task``, in the place of its number."""
    from lerobot.datasets.io_utils import load_tasks

    with undamaged(root / "meta" / "tasks.parquet"):
        tasks = load_tasks(root)
    names = {index(number): str(text) for text, number in zip(tasks.index, tasks["task_index"].tolist(), strict=True)}
    columns["task"] = [names.get(int(number), "") for number in columns.pop("task_index")]


def _check(folder: Path) -> None:
    if not is_dataset(folder):
        raise MemobenchError(f"{folder} is no dataset (there is no meta/info.json); name one that was generated")


def _rows(folder: Path, episode_index: int | None = None) -> list[dict[str, Any]]:
    """The rows of meta/episodes, or that of one episode, in their order and without statistics."""
    own = ("episode_index", "length", "dataset_from_index", "tasks", *EpisodeRecord.model_fields)
    chosen = None if episode_index is None else [("episode_index", "==", episode_index)]
    return _read(folder / "meta" / "episodes", own, chosen).sort_by("episode_index").to_pylist()


def _place(folder: Path, row: dict[str, Any], text: str | None) -> EpisodePlace:
    number = int(row["episode_index"])
    record = from_frames(text, f"{folder}, episode {number}") if text else from_meta(row)
    instructions = tuple(row.get("tasks") or ())
    return EpisodePlace(number, int(row["dataset_from_index"]), int(row["length"]), record, instructions)


def _read(folder: Path, names: tuple[str, ...] | None, chosen: list[tuple[str, str, int]] | None) -> pa.Table:
    """Those of the columns that are there (None: all), of all files: merged ones need not have the same."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = []
    for path in sorted(folder.rglob("*.parquet")):
        with undamaged(path):
            there = pq.read_schema(path).names
            columns = None if names is None else [name for name in names if name in there]
            tables.append(pq.read_table(path, columns=columns, filters=chosen))
    if not tables:
        raise MemobenchError(f"{folder} holds no parquet file: the dataset is not whole; fetch or generate it again")
    return pa.concat_tables(tables, promote_options="permissive")


def _read_columns(root: Path, episode_index: int) -> Columns:
    """An episode's frames and, where they are, its states."""
    chosen = [("episode_index", "==", episode_index)]
    table = _read(root / "data", None, chosen).sort_by("frame_index")
    columns: Columns = {}
    for name in table.column_names:
        values = table.column(name).to_pylist()
        is_text = name == LANGUAGE or isinstance(values[0], str)
        columns[name] = values if is_text else np.array(values)
    for name in ("action", EXECUTED_ACTION, "observation.state", OBJECTS, PRIVILEGED):
        if name in columns:
            columns[name] = columns[name].astype(np.float32)
    if (root / "states").is_dir():
        states = _read(root / "states", None, chosen).sort_by("frame_index")
        columns["states"] = np.array(states.column("state").to_pylist(), dtype=np.float64)
    return columns
