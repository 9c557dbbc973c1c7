"""Names of a dataset's files, and names, types and meanings of its columns."""

from __future__ import annotations

import glob
import hashlib
import os
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from lerobot_memobench.constants import CAMERAS, OBS_PHASE, OBS_STEP
from lerobot_memobench.datasets.demonstration import (
    HELD_COLUMN,
    INSTRUCTION_COLUMN,
    LEVEL_COLUMNS,
    MAX_CHECKPOINTS,
    MEMORY_COLUMN,
)
from lerobot_memobench.io import cache_folder, files_below
from lerobot_memobench.sim.convention import MIRRORED
from lerobot_memobench.sim.object_layout import NAMES

STAGING = ".staging"  # folder of an unfinished run within its destination
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
    """Return a dataset's folder, or a link to it in the cache: LeRobot reads names like ``obj [v2]`` as patterns."""
    path = str(folder.absolute())
    if glob.escape(path) == path or not folder.is_dir():
        return folder
    # LeRobot caches tables by path, so the link is the same at every call.
    link = cache_folder() / "datasets" / hashlib.sha256(os.fsencode(path)).hexdigest()[:16]
    link.parent.mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):
        link.symlink_to(path)
    return link


EPISODE_INFO = "episode_info"  # column of frames with the episode's record at its first frame, empty elsewhere
LANGUAGE = "language_persistent"  # LeRobot's column of language rows
OBJECTS = "observation.environment_state"
"""Column of visible objects in datasets without images; LeRobot uses a column of this name as an input."""
PRIVILEGED = "privileged.environment_state"
"""The same in datasets with images, so that LeRobot's own commands do not train on object poses there."""
EXECUTED_ACTION = "executed_action"
"""The action that moved the arm; `action` is the expert's, which differs in perturbed episodes. LeRobot learns every
column whose name begins with `action`, so this name does not."""
PROPRIO_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"]
ACTION_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper"]


class Column(NamedTuple):
    """Type of a column, names of its numbers, and its meaning."""

    dtype: str
    names: list[str] | None
    meaning: str


OBJECT_COLUMNS = {
    OBJECTS: Column("float32", NAMES, "objects visible to the cameras, 16 slots: see `memobench objects`"),
    PRIVILEGED: Column(
        "float32",
        NAMES,
        "the same in datasets with images: true poses, which LeRobot's own training does not use as an input; "
        "`memobench_mem` with `perception=objects` reads them, others with `lerobot train obs_type=both`",
    ),
}
COLUMNS = {
    "observation.state": Column("float32", PROPRIO_NAMES, "end-effector position 3, axis-angle 3, gripper joints 2"),
    "action": Column(
        "float32", ACTION_NAMES, "OSC pose delta 6 (±1 is ±0.05 m, ±0.5 rad), gripper (−1 opens, +1 closes)"
    ),
    EXECUTED_ACTION: Column(
        "float32",
        ACTION_NAMES,
        "the applied action; differs from `action` where the arm was perturbed (`generate --perturb`)",
    ),
    OBS_PHASE: Column(
        "float32", ["phase"], "0 demonstration prompt and the rest after it (the policy does not act), 1 execution"
    ),
    OBS_STEP: Column("float32", ["step"], "control steps since that phase began; -1 in the execution of strict tasks"),
    HELD_COLUMN: Column(
        "bool",
        ["action_has_no_effect"],
        "the scene of a strict task is held at home in the execution: the action, zeros, has no effect",
    ),
    "checkpoint.index": Column(
        "int64", ["completed_in_order"], "number of checkpoints completed in order before this frame"
    ),
    "checkpoint.operation": Column(
        "int64",
        ["0_storage_1_update_2_compression_-1_none"],
        "of the next one: 0 Storage, 1 Update, 2 Compression; −1 when none is left",
    ),
    "checkpoint.completed": Column(
        "bool",
        [f"checkpoint_{k}" for k in range(MAX_CHECKPOINTS)],
        "checkpoint k has been satisfied by now; false beyond the task's count",
    ),
    "checkpoint.event": Column(
        "bool", ["satisfied_first"], "a checkpoint is satisfied for the first time at this frame"
    ),
    LEVEL_COLUMNS["coarse"]: Column(
        "string", None, "the state that the present checkpoint reaches; after the last checkpoint its text remains"
    ),
    LEVEL_COLUMNS["intermediate"]: Column("string", None, "the event of the present checkpoint, in the past tense"),
    LEVEL_COLUMNS["fine"]: Column("string", None, "the same in more detail, in the past tense"),
    INSTRUCTION_COLUMN: Column("string", None, "the intermediate text as an instruction, in the present tense"),
    MEMORY_COLUMN: Column(
        "string", None, "the intermediate texts of the checkpoints completed in order so far; empty at the start"
    ),
    LANGUAGE: Column(
        "language",
        None,
        "LeRobot's language rows for its training recipes: style `subtask`, the next step as an instruction; style "
        "`memory`, the completed steps",
    ),
    EPISODE_INFO: Column(
        "string",
        None,
        "JSON at an episode's first frame, else empty: the fields of the table below, and versions, because LeRobot's "
        "dataset tools keep only columns of frames",
    ),
}
MEANINGS = {
    "observation.images.image": "third-person camera",
    **{f"observation.images.{name}": "wrist camera" for name in ("wrist_image", "image2")},
    **{name: column.meaning for name, column in (OBJECT_COLUMNS | COLUMNS).items()},
}


def dataset_features(
    image_size: tuple[int, int] | None, cameras: Collection[str] = tuple(CAMERAS)
) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns; ``image_size`` is (height, width), None without images."""
    features: dict[str, dict[str, Any]] = {}
    stated = {} if {*cameras} == {*CAMERAS} else {"convention": MIRRORED}  # LeRobot merges equal descriptions alone
    if image_size is not None:
        video = {"dtype": "video", "shape": (*image_size, 3), "names": ["height", "width", "channels"]} | stated
        features = {image_key(camera): dict(video) for camera in cameras}
    objects = OBJECTS if image_size is None else PRIVILEGED
    for name, (dtype, names, _) in ({objects: OBJECT_COLUMNS[objects]} | COLUMNS).items():
        features[name] = {"dtype": dtype, "shape": (len(names or [name]),), "names": names}
    return features


def image_key(camera: str) -> str:
    """Return the column name of a camera, which is also the name of its observation."""
    return f"observation.images.{camera}"


def objects_column(names: Collection[str]) -> str:
    """Return the column of objects among ``names``: `PRIVILEGED`, or without images `OBJECTS`."""
    return PRIVILEGED if PRIVILEGED in names else OBJECTS
