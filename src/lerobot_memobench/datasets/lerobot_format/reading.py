"""Read a dataset of this package: the record of each episode, and an episode's frames.

LeRobot's dataset tools may have edited it; the records are then read from the frames (`EpisodeRecord`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from operator import index
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from lerobot_memobench.datasets.demonstration import EARLIER_COLUMNS, HELD_COLUMN
from lerobot_memobench.datasets.lerobot_format.columns import (
    EPISODE_INFO,
    LANGUAGE,
)
from lerobot_memobench.datasets.lerobot_format.layout import EPISODES, is_dataset
from lerobot_memobench.datasets.lerobot_format.tables import (
    is_numeric,
    numbers,
    read_info,
    read_table,
    read_tasks,
)
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Malformed, Number, Whole, first_fault, parsed
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
"""Fields of a record that are determined by task, seed and actions."""


# --- the record of an episode ---


class EpisodeRecord(BaseModel):
    """Fields of an episode as a whole: its task, seed, placement, hashes.

    A dataset stores it twice: in ``meta/episodes``, which ``LeRobotDataset(…, episode_filter=…)`` reads, and as JSON in
    the frames' column `EPISODE_INFO`, at each episode's first frame. LeRobot's dataset tools (``lerobot-edit-dataset``)
    keep the columns of frames, but drop unknown columns of ``meta/episodes`` and unknown files.

    A field's description is its meaning in the dataset card.

    Attributes:
        seed: -1 if unknown.
        digest: None in datasets of earlier versions.
        world: ``libero``; None for the scenes that version 0.2 modelled in code, as for stand_ins.
        stand_ins: classes whose missing scans this package's objects replaced.
        versions: versions of the packages on which the numbers depend; None if unknown.
    """

    model_config = ConfigDict(frozen=True)

    task_name: str = Field(description="task of the catalogue")
    memory_type: str = Field(description="temporal, spatial, object or procedural")
    family: str = Field("", description="group of similar tasks")
    operations: str = Field("", description="labels of the checkpoints in order, e.g. SUC")
    seed: Whole = Field(description="seed of the scene")
    referent: str = Field(
        "fixed",
        description="fixed; random: the demonstration prompt decides the goal; drawn: the seed decides it "
        "(strict tasks)",
    )
    variant: Count = Field(description="number of the referent or order; 0 is the published one")
    success: bool | None = Field(None, description="the goal was reached")
    exec_start_index: Count = Field(description="first frame of the execution")
    key_frames: list[Whole] = Field(description="frame at which each checkpoint was completed in order, −1 if never")
    scene_hash: str | None = Field(None, description="hash of the initial scene")
    fixture_poses: dict[str, list[Number]] | None = Field(
        None, description="JSON, fixture to position and quaternion wxyz"
    )
    digest: str | None = Field(None, description="sha256 of states, actions and labels")
    world: str | None = None
    stand_ins: list[str] | None = None
    versions: dict[str, str] | None = None

    @classmethod
    def meanings(cls) -> dict[str, str]:
        """Return the described fields and their descriptions."""
        return {name: field.description for name, field in cls.model_fields.items() if field.description}

    def in_frames(self) -> str:
        """Return the text of the first frame's column."""
        return self.model_dump_json(exclude_none=True)

    def in_meta(self) -> dict[str, Any]:
        """Return the columns of ``meta/episodes``."""
        elsewhere = {} if self.world is None else {"world": self.world, "stand_ins": json.dumps(self.stand_ins or [])}
        return self.model_dump(exclude={"versions", "world", "stand_ins"}) | {
            "key_frames": np.array(self.key_frames, dtype=np.int64),
            "fixture_poses": json.dumps(self.fixture_poses),
            **elsewhere,
        }


def from_frames(text: str, where: str) -> EpisodeRecord:
    """Return the record in the text of an episode's first frame.

    Args:
        text: JSON.
        where: dataset and episode, for the message.

    Raises:
        MemobenchError: the text is no record.
    """
    try:
        value = parsed(text)
        try:
            return EpisodeRecord.model_validate(value)
        except ValidationError as error:
            raise Malformed(first_fault(error.errors(include_url=False), value)) from None
    except Malformed as error:
        raise MemobenchError(
            f"{where}: its column {EPISODE_INFO} is not as this package writes it ({error}); take the dataset from its "
            "source again"
        ) from None


def from_meta(row: Mapping[str, Any]) -> EpisodeRecord | None:
    """Return the record in a row of ``meta/episodes``; None if it is missing or incomplete."""
    values = {key: row[key] for key in EpisodeRecord.model_fields if row.get(key) is not None}
    try:
        in_json = {key: json.loads(values.get(key, "null")) for key in ("fixture_poses", "stand_ins")}
        return EpisodeRecord.model_validate(values | in_json)
    except (ValidationError, ValueError, TypeError):
        return None


# --- episodes ---


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
        whole: fields of the episode as a whole.
        start: first frame in the dataset's global index.
    """

    task_name: str
    variant: int
    seed: int
    referent: str
    exec_start: int
    columns: Columns
    whole: dict[str, Any]
    start: int = 0
    world: str | None = None


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
    fields = record.model_dump(include=WHOLE)
    whole = {key: value for key, value in fields.items() if value not in (None, "")}
    if LANGUAGE in columns:
        whole[LANGUAGE] = columns[LANGUAGE][0]
        changed = next((frame for frame, rows in enumerate(columns[LANGUAGE]) if rows != whole[LANGUAGE]), None)
        if changed is not None:
            raise MemobenchError(
                f"{LANGUAGE} at frame {changed} differs from frame 0, expected equal rows in an episode"
            )
    return RecordedEpisode(
        record.task_name,
        record.variant,
        record.seed,
        record.referent,
        record.exec_start_index,
        columns,
        whole,
        place.start,
        record.world,
    )


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
        values = numbers(column) if is_numeric(column.type) else column.to_pylist()
        columns[EARLIER_COLUMNS.get(name, name)] = values
    tasks = read_tasks(root)
    names = {index(number): str(text) for text, number in zip(tasks.index, tasks["task_index"].tolist(), strict=True)}
    columns["task"] = [names.get(int(number), "") for number in columns.pop("task_index")]
    if (root / "states").is_dir():
        states = read_table(root / "states", rows=chosen).sort_by("frame_index")
        columns["states"] = numbers(states.column("state"))
    return columns
