"""What a dataset's folder and its columns are called, and whether a folder holds one."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.labels import MAX_CHECKPOINTS
from lerobot_memobench.datasets.lerobot_format.record import EPISODE_INFO
from lerobot_memobench.datasets.staging.folders import STAGING
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.protocol import ACTION_DIM, CAMERAS, PROPRIO_DIM

DEFAULT_REPO_ID = "memobench/memobench"
HDF5_FOLDER = "hdf5"
MANIFEST_FILE = "manifest.json"

PROPRIO_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right"]
ACTION_NAMES = ["x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "gripper"]

OBJECTS = "observation.environment_state"
"""What could be seen as objects, in datasets without pictures: LeRobot takes a column of this name for an input."""
PRIVILEGED = "privileged.environment_state"
"""The same in datasets with pictures: who trains on these by LeRobot's own commands learns from no object poses."""
EXECUTED_ACTION = "executed_action"
"""What moved the arm; `action` is what the expert would have done, which differs where the arm was moved off its way.
LeRobot takes every column that begins with `action` for something to be learned."""

TOP_LEVEL = (HDF5_FOLDER, "videos", "states", "data", "README.md", MANIFEST_FILE, "meta")
"""Moved into place in this order; with `meta` the folder becomes a dataset, without it the manifest is the last."""


def image_key(camera: str) -> str:
    """Return the column name of a camera; the env's observations arrive at a policy under the same name."""
    return f"observation.images.{camera}"


def objects_column(names: Collection[str]) -> str:
    """Return which of a dataset's columns holds the objects.

    Datasets with pictures of earlier versions have them under LeRobot's name.
    """
    return PRIVILEGED if PRIVILEGED in names else OBJECTS


def dataset_features(image_size: tuple[int, int] | None, *, objects: bool = False) -> dict[str, dict[str, Any]]:
    """Return LeRobot's description of the columns; ``image_size`` is (height, width), None without images."""
    from lerobot_memobench.sim.object_slots import SIZE

    def feature(dtype: str, shape: tuple[int, ...] = (1,), names: list[str] | None = None) -> dict[str, Any]:
        return {"dtype": dtype, "shape": shape, "names": names}

    features: dict[str, dict[str, Any]] = {}
    if image_size is not None:
        for camera in CAMERAS:
            features[image_key(camera)] = feature("video", (*image_size, 3), ["height", "width", "channels"])
    if objects:
        features[OBJECTS if image_size is None else PRIVILEGED] = feature("float32", (SIZE,))
    completed = [f"checkpoint_{k}" for k in range(MAX_CHECKPOINTS)]
    return features | {
        "observation.state": feature("float32", (PROPRIO_DIM,), PROPRIO_NAMES),
        "action": feature("float32", (ACTION_DIM,), ACTION_NAMES),
        EXECUTED_ACTION: feature("float32", (ACTION_DIM,), ACTION_NAMES),
        "phase": feature("int64"),
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


def is_dataset(folder: Path) -> bool:
    """Whether ``folder`` holds a finished LeRobotDataset."""
    return (folder / "meta" / "info.json").is_file()


def check_destination(out: Path) -> None:
    """Raise unless ``out`` is absent, empty, or holds nothing but an unfinished run."""
    if is_dataset(out):
        raise MemobenchError(f"{out} already holds a finished dataset; name another folder or delete this one first")
    if out.exists() and not out.is_dir():
        raise MemobenchError(f"{out} is a file, expected a folder to write a dataset to; name another path")
    # What an interrupted move left beside the staging folder will be replaced.
    strangers = [p.name for p in out.iterdir() if p.name != STAGING] if out.is_dir() else []
    if strangers and not ((out / STAGING).is_dir() and set(strangers) <= set(TOP_LEVEL)):
        raise MemobenchError(
            f"{out} holds {', '.join(sorted(strangers)[:3])}, no part of a dataset being made; name an empty folder"
        )
