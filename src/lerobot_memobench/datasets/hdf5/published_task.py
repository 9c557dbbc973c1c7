"""The task that a demonstration in the published layout shows."""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

from lerobot_memobench.datasets.hdf5.layout import SUFFIX, Unusable
from lerobot_memobench.datasets.hdf5.reading import PublishedDemo, PublishedFile
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import file_name
from lerobot_memobench.tasks.catalogue import get_task, load_task, task_names
from lerobot_memobench.tasks.task import BDDL_FILE, MEMORY_TYPES, METADATA_FILE, Task

UNKNOWN = "tasks"
"""Folder of a task whose memory type nothing tells."""


def task_of(file: PublishedFile, demo: PublishedDemo) -> Task:
    """Return the task that a demonstration shows, from the file's own BDDL and metadata.

    Raises:
        Unusable: they do not make a task, or its name or memory type names no folder.
    """
    name = _folder_name(task_name(file), "the task's name")
    ours = file.task_metadata
    metadata = dict(demo.metadata if ours is None else ours)
    if ours is None:
        # The frames differ between demonstrations, the task must not: its scene is compiled once.
        goals = metadata.get("subtask_goals")
        metadata["key_frame"] = [-1] * len(goals) if isinstance(goals, list) else []
        metadata["timestep_exec_start_idx"] = -1
    memory_type = _folder_name(file.attribute("memory_type") or _memory_type(name, file) or UNKNOWN, "memory_type")
    task = _load(name, memory_type, file.bddl_text, json.dumps(metadata, sort_keys=True))
    if name in task_names(suite=None):
        known = get_task(name)
        if "family" not in metadata:
            task = replace(task, family=known.family)
        if (task.bddl_text, task.metadata) == (known.bddl_text, known.metadata):
            task = known
    return task.variant(int(demo.extras.get("variant", 0))) if ours is not None else task


def unlike_the_catalogue(task: Task) -> str | None:
    """Return in what a task differs from the catalogue's of its name, which everything else finds by that name.

    None where it is the same, or the catalogue has none.
    """
    if task.name not in task_names(suite=None):
        return None
    known = get_task(task.name)
    parts = {
        "memory type": task.memory_type == known.memory_type,
        "instruction": task.language == known.language,
        "objects": (task.objects, task.fixtures) == (known.objects, known.fixtures),
        "placement": (task.regions, set(task.init)) == (known.regions, set(known.init)),
        "goal": task.goal == known.goal,
        "checkpoints": task.checkpoints == known.checkpoints,
    }
    differs = [name for name, same in parts.items() if not same]
    if not differs:
        return None
    return (
        f"not as the catalogue's {task.name}: {', '.join(differs)}; the dataset holds the file's, but `lerobot eval` "
        "and `memobench validate` know the catalogue's by that name"
    )


def task_name(file: PublishedFile) -> str:
    """Return the task's name: the folder of ``bddl_file_name``, or its stem, or the HDF5 file's."""
    path = PurePosixPath(file.bddl_name.replace("\\", "/"))
    if path.name == BDDL_FILE and path.parent.name not in ("", "..", "."):
        return path.parent.name
    if path.stem not in ("", "..", "task_config"):
        return path.stem
    return file.path.name.removesuffix(SUFFIX).removesuffix(file.path.suffix)


def _folder_name(text: str, what: str) -> str:
    try:
        return file_name(text, what)
    except MemobenchError as error:
        raise Unusable(str(error)) from None


def _memory_type(name: str, file: PublishedFile) -> str:
    if name in task_names(suite=None):
        return get_task(name).memory_type
    folders = [*PurePosixPath(file.bddl_name.replace("\\", "/")).parts, *file.path.resolve().parts]
    return next((folder for folder in reversed(folders) if folder in MEMORY_TYPES), "")


@lru_cache(maxsize=64)
def _load(name: str, memory_type: str, bddl_text: str, metadata: str) -> Task:
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent).resolve() / memory_type / name
        folder.mkdir(parents=True)
        (folder / BDDL_FILE).write_text(bddl_text, encoding="utf-8")
        (folder / METADATA_FILE).write_text(metadata, encoding="utf-8")
        try:
            return load_task(folder)
        except MemobenchError as error:
            told = str(error).replace(str(folder / METADATA_FILE), "meta_data")
            raise Unusable(told.replace(str(folder / BDDL_FILE), "bddl_file_content")) from None
