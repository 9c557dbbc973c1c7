"""Restore a demonstration from a group of the published layout: its task, its execution, its checkpoints.

The layout holds states, not what the arm felt or which predicates held. Proprioception and visible objects are read off
the states in the simulator; where a stranger's demonstration prompt highlights something is not known. Checkpoint
columns come from the key frames where all are there; where one is missing (-1) the predicates are evaluated on the
states, with the latches and orders that a rollout has.
"""

from __future__ import annotations

import json
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration, digest
from lerobot_memobench.datasets.hdf5.reading import SUFFIX, PublishedDemo, PublishedFile, Unusable, truth_from_intervals
from lerobot_memobench.datasets.hdf5.writing import Pose
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.experts.demonstration_prompt import highlights_at
from lerobot_memobench.io import file_name
from lerobot_memobench.sim.assets.kitchen import TABLE_TOP
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.placement import GAP
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, load_task, task_names
from lerobot_memobench.tasks.progress import Progress
from lerobot_memobench.tasks.task import BDDL_FILE, MEMORY_TYPES, METADATA_FILE, Task

NO_SEED = -1
"""Seed of a demonstration that does not say it."""
UNKNOWN = "tasks"
"""Folder of a task whose memory type nothing tells."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def restore(task: Task, demo: PublishedDemo) -> Demonstration:
    """Return the demonstration of a checked group, without images.

    Raises:
        Unusable: what the group says contradicts itself or the task.
    """
    sim = _simulation(task)
    if demo.states.shape[1] != sim.state_dim:
        raise Unusable(f"states have width {demo.states.shape[1]}, expected {sim.state_dim} of task {task.name}")
    exec_start = execution_start(task, demo)
    _check_clock(demo.states, exec_start)
    told = _told_truth(task, demo, exec_start)
    poses = fixture_poses(sim, task, demo)
    ours = "success" in demo.extras
    proprio, objects, satisfied, success = _read_off(sim, task, demo.states, exec_start, poses, ours=ours)
    try:
        restored = Demonstration(
            task=task,
            seed=int(demo.extras.get("seed", NO_SEED)),
            referent=str(demo.extras.get("referent", "fixed")),
            variant=int(demo.extras.get("variant", 0)),
            states=demo.states,
            actions=demo.actions,
            proprio=proprio,
            images=None,
            exec_start=exec_start,
            satisfied=satisfied if told is None else told,
            success=bool(demo.extras.get("success", success or (told is not None and told.shape[1] > 0))),
            fixture_poses=poses,
            model_xml=demo.model_file,
            scene_hash=str(demo.extras.get("scene_hash", "")),
            objects=objects,
        )
        found = digest(restored)
    except MemobenchError as error:
        raise Unusable(str(error)) from None
    if demo.extras.get("digest", found) != found:
        raise Unusable("its states, actions or labels are not those that were written (the digest differs)")
    return restored


def _told_truth(task: Task, demo: PublishedDemo, exec_start: int) -> NDArray[np.bool_] | None:
    """Return the (T, K) truth that the group tells; None where the states have to."""
    frames = key_frames(task, demo, exec_start)
    intervals = demo.extras.get("satisfied_intervals")
    if intervals is not None:
        return truth_from_intervals(intervals, len(demo.states))
    if frames and min(frames) >= 0:
        known: NDArray[np.bool_] = np.arange(len(demo.states))[:, None] >= np.array(frames)
        return known
    return None


def execution_start(task: Task, demo: PublishedDemo) -> int:
    """Return the frame at which execution starts.

    Where ``timestep_exec_start_idx`` is missing (-1) it is 0 for a task without demonstration prompt, else the last
    frame at which the scene is back exactly where it began.
    """
    value = demo.metadata.get("timestep_exec_start_idx", -1)
    values = value if isinstance(value, list) else [value]
    if not values or not all(isinstance(item, int) and not isinstance(item, bool) for item in values):
        raise Unusable(f"meta_data has timestep_exec_start_idx {value!r}, expected a frame or -1")
    start = max(values)
    if start >= len(demo.states):
        raise Unusable(f"execution starts at frame {start}, but it has {len(demo.states)} frames")
    if start >= 0:
        return start
    if task.prompt is None:
        return 0
    back = np.flatnonzero((demo.states[1:, 1:] == demo.states[0, 1:]).all(axis=1)) + 1
    if back.size:
        return int(back[-1])
    raise Unusable(
        "timestep_exec_start_idx is -1 for a task with a demonstration prompt, and no later frame shows the scene back "
        "at its start: write the frame at which execution starts into meta_data"
    )


def key_frames(task: Task, demo: PublishedDemo, exec_start: int) -> list[int]:
    """Return ``key_frame``, one per checkpoint (-1 where unknown), after checking it."""
    frames = demo.metadata.get("key_frame", [-1] * len(task.checkpoints))
    if (
        not isinstance(frames, list)
        or len(frames) != len(task.checkpoints)
        or not all(isinstance(frame, int) and not isinstance(frame, bool) for frame in frames)
    ):
        raise Unusable(f"meta_data has key_frame {frames!r}, expected {len(task.checkpoints)} frames, -1 where unknown")
    known = [frame for frame in frames if frame >= 0]
    if known != sorted(known):
        raise Unusable(f"key_frame {frames} is not in order: checkpoints are completed one after the other")
    if any(not exec_start <= frame < len(demo.states) for frame in known):
        raise Unusable(f"key_frame {frames} is outside of the execution, frames {exec_start} to {len(demo.states) - 1}")
    return frames


def fixture_poses(sim: Simulation, task: Task, demo: PublishedDemo) -> dict[str, Pose]:
    """Return where the fixtures stood: as this package wrote it, else by ``model_file``, else their regions' middle."""
    names = list(sim.fixture_poses())
    if "fixture_poses" in demo.extras:
        return {name: np.array(pose) for name, pose in demo.extras["fixture_poses"].items()}
    found = read_fixture_poses(demo.model_file, names) if demo.model_file.strip() else {}
    return {name: found[name] if name in found else _middle(sim, task, name) for name in names}


def _middle(sim: Simulation, task: Task, name: str) -> Pose:
    """The pose of a fixture in the middle of the table region that it starts in."""
    places = {atom.args[0]: atom.args[1] for atom in task.init if len(atom.args) == 2}
    region = task.regions.get(places.get(name, ""))
    if region is None or not region.ranges:
        return sim.fixture_poses()[name]
    x1, y1, x2, y2 = region.ranges[0]
    half = sum(region.yaw) / 4
    height = TABLE_TOP - sim.assets[name].bottom + GAP
    return np.array([(x1 + x2) / 2, (y1 + y2) / 2, height, np.cos(half), 0.0, 0.0, np.sin(half)])


def read_fixture_poses(xml: str, names: Iterable[str]) -> dict[str, Pose]:
    """Return where the named fixtures stand in an MJCF text; those it does not have are left out.

    A fixture is the body of its name, or of its name with robosuite's suffix ``_main``.

    Raises:
        Unusable: the text is no XML, or a pose in it is no pose.
    """
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise Unusable(f"model_file is no XML ({error})") from None
    bodies = {body.get("name"): body for body in root.iter("body")}
    found: dict[str, Pose] = {}
    for name in names:
        body = bodies.get(name, bodies.get(f"{name}_main"))
        if body is None:
            continue
        found[name] = np.concatenate([_numbers(body, "pos", (0.0, 0.0, 0.0)), _numbers(body, "quat", IDENTITY)])
    return found


def _numbers(body: ElementTree.Element, key: str, default: tuple[float, ...]) -> Pose:
    text = body.get(key)
    if text is None:
        return np.array(default)
    try:
        values = np.array([float(word) for word in text.split()])
    except ValueError:
        values = np.array([])
    if values.shape != (len(default),) or not np.isfinite(values).all():
        raise Unusable(f"model_file gives the body {body.get('name')} {key}={text!r}, expected {len(default)} numbers")
    return values


def _read_off(
    sim: Simulation,
    task: Task,
    states: NDArray[np.float64],
    exec_start: int,
    poses: dict[str, Pose],
    *,
    ours: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], bool]:
    """Show the states to the simulator one after the other; return proprioception, visible objects, truth and success.

    Of a demonstration of ``ours`` the prompt is known, and truth and success are written.
    """
    progress = Progress(task)
    look = ObjectSlots(sim)
    proprio, objects, satisfied = [], [], []
    success = False
    for frame, state in enumerate(states):
        sim.set_state(state, poses)
        proprio.append(sim.proprio())
        sim.highlights = highlights_at(task, sim, frame) if ours and frame < exec_start else ()
        objects.append(look.observe())
        if frame == exec_start:
            sim.begin_execution()
        if not ours and frame > exec_start:  # the world is evaluated after a control step, see Demonstration
            success = progress.step(sim.holds) or success
        satisfied.append(progress.satisfied)
    truth = np.array(satisfied, dtype=np.bool_).reshape(len(states), len(task.checkpoints))
    return np.array(proprio, dtype=np.float32), np.array(objects), truth, success


def _check_clock(states: NDArray[np.float64], exec_start: int) -> None:
    """Raise when the frames are not in the order of their time, which may start anew where the prompt ends.

    That is where the execution starts, or where the scene is first as it then is: the robot idles in between.

    Only a time that runs evenly is taken for a clock: other writers leave zeros or something else there.
    """
    time = states[:, 0]
    ticks = np.unique(np.round(time, 5))
    if len(ticks) < 3 or np.ptp(np.diff(ticks)) > 0.01 * np.diff(ticks).mean():
        return
    moving = np.flatnonzero((states[:exec_start] != states[exec_start]).any(axis=1))
    rest = int(moving[-1]) + 1 if moving.size else 0
    back = [int(frame) for frame in np.flatnonzero(np.diff(time) < 0) + 1 if frame != rest]
    if back:
        raise Unusable(
            f"its states are not in order: frame {back[0]} is earlier ({time[back[0]]:.2f} s) than the one before it "
            f"({time[back[0] - 1]:.2f} s)"
        )


@lru_cache(maxsize=1)
def _simulation(task: Task) -> Simulation:
    """The last task's simulation stays: a file's demonstrations come one after another."""
    sim = Simulation(task)
    sim.reset(0)
    return sim


# --- the task ---


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
