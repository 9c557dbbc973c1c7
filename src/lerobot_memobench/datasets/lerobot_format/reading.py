"""Read episodes of a dataset: the record of each, and an episode's frames.

LeRobot's dataset tools may have edited it; the records are then read from the frames (`EpisodeRecord`).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_memobench.datasets.demonstration import EARLIER_COLUMNS, HELD_COLUMN
from lerobot_memobench.datasets.lerobot_format.columns import (
    EPISODE_INFO,
    LANGUAGE,
)
from lerobot_memobench.datasets.lerobot_format.layout import EPISODES, is_dataset
from lerobot_memobench.datasets.lerobot_format.record import EpisodeRecord, from_frames, from_meta
from lerobot_memobench.datasets.lerobot_format.tables import (
    is_numeric,
    numbers,
    read_info,
    read_table,
    read_tasks,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, suite_of
from lerobot_memobench.tasks.task import STRICT

if TYPE_CHECKING:
    pass

Columns = dict[str, Any]
STRANGER = (
    "it has neither task nor seed: another program made it, or LeRobot's tools edited a dataset of an earlier version, "
    f"without the column {EPISODE_INFO}, and dropped the fields of meta/episodes; generate it again"
)
"""Message for an episode without a record."""


@dataclass(frozen=True)
class EpisodePlace:
    """An episode in a dataset.

    Attributes:
        index: number in the dataset.
        start: first frame in the dataset's global index.
        length: number of frames.
        record: None if this package wrote none.
        instructions: distinct instructions of its frames.
    """

    index: int
    start: int
    length: int
    record: EpisodeRecord | None
    instructions: tuple[str, ...] = ()


def list_episodes(folder: Path) -> list[EpisodePlace]:
    """Return a dataset's episodes with their records, in order.

    Raises:
        MemobenchError: the folder is no dataset, or a record in it is damaged.
    """
    read_info(folder)
    rows = _rows(folder)
    own = ("episode_index", EPISODE_INFO)
    first = read_table(folder / "data", own.__contains__, [("frame_index", "==", 0)]).to_pylist()
    texts = {int(row["episode_index"]): row.get(EPISODE_INFO) for row in first}
    return [_place(folder, row, texts.get(row["episode_index"])) for row in rows]


def episodes_where(folder: Path | str, **wanted: Any) -> list[int]:
    """Return the numbers of a dataset's episodes with all ``wanted`` fields, for LeRobot's ``episodes``.

    ``LeRobotDataset(…, episodes=episodes_where(folder, memory_type="spatial"))`` selects like LeRobot's
    ``episode_filter``, and also works after LeRobot's dataset tools have dropped the columns that the filter needs.

    Raises:
        MemobenchError: an unknown field (see `EpisodeRecord`), or no such episode.
    """
    unknown = sorted(set(wanted) - set(EpisodeRecord.model_fields))
    if unknown:
        raise MemobenchError(
            f"{unknown[0]!r} is no field of an episode; expected one of {', '.join(EpisodeRecord.model_fields)}"
        )
    records = {place.index: place.record for place in list_episodes(Path(folder)) if place.record is not None}
    found = [n for n, record in records.items() if all(getattr(record, k) == v for k, v in wanted.items())]
    if not found:
        asked = ", ".join(f"{key}={value!r}" for key, value in wanted.items())
        raise MemobenchError(f"{folder} has no episode with {asked}; `memobench describe {folder}` lists them")
    return found


def check_suite_of(folder: Path, suite: str) -> None:
    """Refuse a LeRobotDataset with a task of another suite; tasks outside the catalogue belong to none.

    Raises:
        MemobenchError: naming the first such task.
    """
    for place in list_episodes(folder) if is_dataset(folder) else ():
        name = place.record.task_name if place.record is not None else ""
        found = suite_of(name)
        if found not in (None, suite):
            raise MemobenchError(
                f"{folder} holds demonstrations of {name!r}, a task of the {found} suite; use --suite {found}"
            )


def check_revision(folder: Path, places: Iterable[EpisodePlace] | None = None) -> None:
    """Refuse a LeRobotDataset with strict demonstrations of earlier versions: of other goals, prompts or holds.

    Args:
        places: its episodes; read from the folder by default.

    Raises:
        MemobenchError: naming the first such episode.
    """
    has_holds = HELD_COLUMN in read_info(folder)["features"]
    for place in list_episodes(folder) if places is None else places:
        record = place.record
        if record is None or record.seed < 0 or suite_of(record.task_name) != STRICT:
            continue
        task = get_task(record.task_name).variant(record.variant)
        same_goal = not place.instructions or task.language in place.instructions
        if not (same_goal and has_holds and record.exec_start_index in (task.prompt_steps or 0, 0)):
            raise MemobenchError(
                f"episode {place.index} of {folder} ({record.task_name}, seed {record.seed}) was made by an earlier "
                "version, whose strict tasks have another instruction, another length of the prompt or no held "
                "frames; generate the demonstrations again"
            )


@dataclass(frozen=True, eq=False)
class RecordedEpisode:
    """An episode of a dataset on disk.

    Attributes:
        columns: values per frame; the column ``task`` is the instruction.
        whole: fields that a replay must reproduce (`EpisodeRecord.determined`), and the language rows.
        start: first frame in the dataset's global index.
    """

    record: EpisodeRecord
    columns: Columns
    whole: dict[str, Any]
    start: int


def read_episode(root: Path | str, episode_index: int) -> RecordedEpisode:
    """Read an episode of a dataset that this package made; without states/, its columns lack ``states``.

    Raises:
        MemobenchError: there is no dataset or no such episode, or another program made it.
    """
    root = Path(root)
    read_info(root)
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
    whole = {key: value for key, value in record.determined().items() if value not in (None, "")}
    if LANGUAGE in columns:
        whole[LANGUAGE] = columns[LANGUAGE][0]
        changed = next((frame for frame, rows in enumerate(columns[LANGUAGE]) if rows != whole[LANGUAGE]), None)
        if changed is not None:
            raise MemobenchError(
                f"{LANGUAGE} at frame {changed} differs from frame 0, expected equal rows in an episode"
            )
    return RecordedEpisode(record, columns, whole, place.start)


def _check_record(row: dict[str, Any], record: EpisodeRecord, texts: list[str | None], length: int) -> None:
    """Raise if the two records of an episode, or its frames, contradict each other."""
    in_meta = from_meta(row)
    for key in EpisodeRecord.model_fields if in_meta is not None else ():
        here, there = getattr(record, key), getattr(in_meta, key)
        if key != "versions" and here != there:
            raise MemobenchError(f"meta/episodes has {key}={there!r}, the frames' column {EPISODE_INFO} {here!r}")
    again = next((frame for frame, text in enumerate(texts) if frame and text), None)
    if again is not None:
        raise MemobenchError(
            f"{EPISODE_INFO} at frame {again} is {texts[again]!r}, expected an empty text except at frame 0"
        )
    if row["length"] != length:
        raise MemobenchError(f"meta/episodes has length={row['length']}, but it has {length} frames")


def _rows(folder: Path, episode_index: int | None = None) -> list[dict[str, Any]]:
    """Return the rows of meta/episodes, or that of one episode, in order and without statistics."""
    own = ("episode_index", "length", "dataset_from_index", "tasks", *EpisodeRecord.model_fields)
    chosen = None if episode_index is None else [("episode_index", "==", episode_index)]
    return read_table(folder / EPISODES, own.__contains__, chosen).sort_by("episode_index").to_pylist()


def _place(folder: Path, row: dict[str, Any], text: str | None) -> EpisodePlace:
    number = int(row["episode_index"])
    record = from_frames(text, f"{folder}, episode {number}") if text else from_meta(row)
    instructions = tuple(row.get("tasks") or ())
    return EpisodePlace(number, int(row["dataset_from_index"]), int(row["length"]), record, instructions)


def _read_columns(root: Path, episode_index: int) -> Columns:
    """Return the columns of an episode's frames, its instructions as ``task``, and, if stored, its states."""
    chosen = [("episode_index", "==", episode_index)]
    table = read_table(root / "data", rows=chosen).sort_by("frame_index")
    columns: Columns = {}
    for name, column in zip(table.column_names, table.columns, strict=True):
        values = np.array(numbers(column)) if is_numeric(column.type) else column.to_pylist()
        columns[EARLIER_COLUMNS.get(name, name)] = values
    tasks = read_tasks(root)
    names = {index(number): str(text) for text, number in zip(tasks.index, tasks["task_index"].tolist(), strict=True)}
    columns["task"] = [names.get(int(number), "") for number in columns.pop("task_index")]
    if (root / "states").is_dir():
        states = read_table(root / "states", rows=chosen).sort_by("frame_index")
        columns["states"] = numbers(states.column("state"))
    return columns
