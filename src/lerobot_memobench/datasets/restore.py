"""Restore a demonstration from a group of the published layout: its task, its execution, its checkpoints.

The layout holds states, but neither proprioception nor the truth of predicates. Proprioception and visible objects are
computed in the simulator from the states. Highlights of demonstration prompts are unknown. Checkpoint columns come from
the key frames; where one is missing (-1) its predicate is evaluated on the states, with the latches and orders of a
rollout.

The order of the joints in a state is that of the attribute ``model_file``, an MJCF text of another program. Only its
bodies and joints are compiled, so it cannot reference files or plugins.
"""

from __future__ import annotations

import json
import tempfile
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from functools import lru_cache
from pathlib import Path, PurePosixPath

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lerobot_memobench.constants import CAMERAS, UPSTREAM_EVALUATIONS
from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5 import NO_SEED, SUFFIX, PublishedDemo, PublishedFile, first_line
from lerobot_memobench.errors import MemobenchError, short
from lerobot_memobench.io import file_name
from lerobot_memobench.sim.asset import TABLE_TOP
from lerobot_memobench.sim.convention import UPRIGHT
from lerobot_memobench.sim.object_slots import ObjectSlots
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task, load_task, task_names
from lerobot_memobench.tasks.progress import HOLD_STEPS, Evaluator
from lerobot_memobench.tasks.task import BDDL_FILE, MEMORY_TYPES, METADATA_FILE, REFERENTS, Task

States = NDArray[np.float64]
Pose = NDArray[np.float64]  # position and quaternion wxyz, (7,)

BASE = "robot0_base"
BASE_TOLERANCE = 1e-3  # largest distance of the arm's base from ours, m
NEAR_TABLE = 0.1
"""Largest height of a fixture's origin above or below the table's top, m; LIBERO's are up to 30 mm above it."""
UNKNOWN = "tasks"  # folder of a task with an unknown memory type


# --- demonstrations ---


def restore(task: Task, demo: PublishedDemo) -> Demonstration:
    """Return the demonstration of a checked group, without images.

    Raises:
        MemobenchError: the group contradicts itself or the task, or is of another scene than the task's.
    """
    sim = _simulation(task)
    states, fixture_poses = _translated(sim, compile_scene(demo.model_file), demo.states)
    exec_start = _execution_start(task, demo)
    _check_clock(demo.states, exec_start)
    frames = _key_frames(task, demo, exec_start)
    evaluate = not frames or min(frames) < 0
    proprio, objects, satisfied, success = _read_states(sim, task, states, fixture_poses, exec_start, evaluate)
    known = np.arange(len(states))[:, None] >= np.array(frames)  # from the key frame on if it is known
    return Demonstration(
        task=task,
        seed=NO_SEED,
        referent=REFERENTS[0],
        variant=0,
        states=states,
        actions=demo.actions,
        proprio=proprio,
        images=None,
        exec_start=exec_start,
        satisfied=np.where(np.array(frames, dtype=int) >= 0, known, satisfied),
        success=success or not evaluate,
        fixture_poses=fixture_poses,
        stand_ins=sim.stand_ins,
        objects=objects,
    )


def _execution_start(task: Task, demo: PublishedDemo) -> int:
    value: int | list[int] = demo.metadata.get("timestep_exec_start_idx", -1)
    start = max(value) if isinstance(value, list) else value
    if start >= len(demo.states):
        raise MemobenchError(f"execution starts at frame {start}, but it has {len(demo.states)} frames")
    if start >= 0:
        return start
    if task.prompt is None:
        return 0
    # A prompt ends by returning the scene to its start.
    back = np.flatnonzero((demo.states[1:, 1:] == demo.states[0, 1:]).all(axis=1)) + 1
    if back.size:
        return int(back[-1])
    raise MemobenchError(
        "timestep_exec_start_idx is -1 for a task with a demonstration prompt, and no later frame shows the scene in "
        "its start state: write the frame at which execution starts into meta_data"
    )


def _key_frames(task: Task, demo: PublishedDemo, exec_start: int) -> list[int]:
    count, length = len(task.checkpoints), len(demo.states)
    frames: list[int] = demo.metadata.get("key_frame", [-1] * count)
    if len(frames) != count:
        raise MemobenchError(f"meta_data has key_frame {short(frames)}, expected {count} frames, -1 where unknown")
    known = [frame for frame in frames if frame >= 0]
    if known != sorted(known):
        raise MemobenchError(f"key_frame {frames} is not in order: checkpoints are completed one after the other")
    if any(not exec_start <= frame < length for frame in known):
        raise MemobenchError(f"key_frame {frames} is outside of the execution, frames {exec_start} to {length - 1}")
    return frames


def _read_states(
    sim: Simulation, task: Task, states: States, fixture_poses: dict[str, Pose], exec_start: int, evaluate: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], bool]:
    # Proprioception (T, 8), objects (T, SIZE), truth of checkpoints (T, K) and success; without ``evaluate`` false.
    goals = [task.goal, *(checkpoint.goal for checkpoint in task.checkpoints)]
    evaluator = Evaluator(goals, HOLD_STEPS // UPSTREAM_EVALUATIONS)
    look = ObjectSlots(sim)
    proprio, objects = [], []
    satisfied = np.zeros((len(states), len(task.checkpoints)), dtype=np.bool_)
    success = False
    for frame, state in enumerate(states):
        sim.set_state(state, fixture_poses)
        proprio.append(sim.proprio())
        objects.append(look.observe())
        if frame == exec_start:
            sim.begin_execution()
        if evaluate and frame > exec_start:  # the world is evaluated after a control step, see Demonstration
            goal, *satisfied[frame] = evaluator.step(sim.holds)
            success = success or goal
    return np.array(proprio, dtype=np.float32), np.array(objects), satisfied, success


def _check_clock(states: NDArray[np.float64], exec_start: int) -> None:
    """Raise if time runs backwards, except at the end of the prompt, the first frame of a rest before the execution."""
    # Only an evenly running time is checked: other programs leave zeros or other numbers there.
    time = states[:, 0]
    ticks = np.unique(np.round(time, 5))
    if len(ticks) < 3 or np.ptp(np.diff(ticks)) > 0.01 * np.diff(ticks).mean():
        return
    moving = np.flatnonzero((states[:exec_start] != states[exec_start]).any(axis=1))
    rest = int(moving[-1]) + 1 if moving.size else 0
    back = [int(frame) for frame in np.flatnonzero(np.diff(time) < 0) + 1 if frame != rest]
    if back:
        raise MemobenchError(
            f"its states are not in order: frame {back[0]} is earlier ({time[back[0]]:.2f} s) than the one before it "
            f"({time[back[0] - 1]:.2f} s)"
        )


@lru_cache(maxsize=1)
def _simulation(task: Task) -> Simulation:
    # The last one is cached, because a file's demonstrations follow each other.
    sim = Simulation(task)
    sim.reset(0)
    return sim


# --- the orientation of stored images ---

ORIENTATIONS = {
    UPRIGHT: (1, 1),
    "mirrored left to right": (1, -1),
    "upside down": (-1, 1),
    "rotated by 180 degrees": (-1, -1),
}
"""How images are stored -> steps over their rows and columns that make them upright."""
NEAR, APART = 12.0, 2.0
"""Largest mean difference of images of one frame, of 255 levels, and the least ratio to the next orientation's."""
SIDE = 32  # side at which images are compared, pixels: edges and textures of other renderers do not count


def orientation_of(file: PublishedFile, demo: PublishedDemo) -> str | None:
    """Return which of `ORIENTATIONS` the first images of a checked group have, by those drawn of its first state.

    None if none is near, or two are.
    """
    sim = _simulation(task_of(file, demo))
    states, fixture_poses = _translated(sim, compile_scene(demo.model_file), demo.states)
    sim.set_state(states[0], fixture_poses)
    stored = next(file.images(demo.group)).items()
    pairs = [(_small(sim.render(CAMERAS[camera])), _small(image)) for camera, image in stored]
    far = {
        name: float(np.mean([np.abs(drawn - image[::rows, ::columns]) for drawn, image in pairs]))
        for name, (rows, columns) in ORIENTATIONS.items()
    }
    best, second = sorted(far, key=lambda name: far[name])[:2]
    return best if far[best] <= NEAR and far[second] >= APART * far[best] else None


def _small(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    return np.asarray(Image.fromarray(image).resize((SIDE, SIDE), Image.Resampling.BOX), np.float32)


# --- the scene of a model file ---

KEPT = {
    "body": ("pos", "quat", "euler", "axisangle", "xyaxes", "zaxis"),
    "joint": ("type", "pos", "axis", "ref"),
    "freejoint": (),
}
"""Element of a worldbody -> attributes that are compiled."""
LEFT_OUT = ("inertial", "camera", "light", "geom", "site")
BY_DEFAULTS = ("class", "childclass")
"""Attributes that refer to defaults elsewhere in the file; MuJoCo removes them from scenes that it saves."""
JOINT_TYPES = ("free", "ball", "slide", "hinge")  # in MuJoCo's order


def joints_of(model: mujoco.MjModel) -> dict[str, tuple[str, NDArray[np.int64]]]:
    """Return each joint's type and the columns of its positions, then velocities, in a state."""
    joints = {}
    for joint in map(model.joint, range(model.njnt)):
        position = joint.qposadr[0] + np.arange(len(joint.qpos0))
        velocity = model.nq + joint.dofadr[0] + np.arange(len(joint.damping))
        columns = 1 + np.concatenate([position, velocity])  # a state begins with the time
        joints[joint.name] = (JOINT_TYPES[int(joint.type[0])], columns)
    return joints


def compile_scene(text: str) -> mujoco.MjModel:
    """Return the bodies and joints of a model file, compiled with placeholder inertias, or raise."""
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise MemobenchError(f"model_file is no XML ({error})") from None
    world = root.find("worldbody")
    if root.tag != "mujoco" or world is None:
        raise MemobenchError("model_file is no MJCF: it has no <mujoco> with a <worldbody>")
    scene = ElementTree.Element("mujoco")
    angles = {"angle": "degree", "eulerseq": "xyz"}
    for compiler in root.iterfind("compiler"):
        angles.update((key, value) for key, value in compiler.attrib.items() if key in angles)
    ElementTree.SubElement(scene, "compiler", {"inertiafromgeom": "false", "autolimits": "false", **angles})
    _copy_bodies(world, ElementTree.SubElement(scene, "worldbody"))
    try:
        return mujoco.MjModel.from_xml_string(ElementTree.tostring(scene, encoding="unicode"))
    except (ValueError, mujoco.FatalError) as error:
        raise MemobenchError(f"MuJoCo cannot compile model_file ({first_line(error)})") from None


def _copy_bodies(source: ElementTree.Element, target: ElementTree.Element) -> None:
    for element in source:
        tag, name = element.tag, element.get("name", "")
        if tag in LEFT_OUT:
            continue
        if tag not in KEPT:
            raise MemobenchError(f"model_file has a <{str(tag)[:40]}> in its worldbody, which is not supported there")
        unread = next((key for key in BY_DEFAULTS if key in element.attrib), None)
        if unread is not None:
            raise MemobenchError(
                f"model_file's {tag} {short(name)} has the attribute {unread!r}, which is not read; store the "
                "scene as MuJoCo saves it"
            )
        attributes = {key: element.attrib[key] for key in ("name", *KEPT[tag]) if key in element.attrib}
        copy = ElementTree.SubElement(target, tag, attributes)
        if tag == "body":  # MuJoCo compiles no moving body without a mass, and its geoms are left out
            ElementTree.SubElement(copy, "inertial", pos="0 0 0", mass="1", diaginertia="1 1 1")
            _copy_bodies(element, copy)


def _body_of(scene: mujoco.MjModel, instance: str) -> str:
    for name in (f"{instance}_main", instance):  # the suffix is robosuite's
        if mujoco.mj_name2id(scene, mujoco.mjtObj.mjOBJ_BODY, name) >= 0:
            return name
    raise MemobenchError(f"model_file has no body {instance!r}, which its task has")


def _translated(sim: Simulation, scene: mujoco.MjModel, states: States) -> tuple[States, dict[str, Pose]]:
    """Return states (T, D) of a model file's scene as states of a simulation's, and the poses of its fixtures."""
    theirs, ours, task_name = joints_of(scene), joints_of(sim.model), sim.task.name
    for name, (kind, _) in ours.items():
        if name not in theirs:
            raise MemobenchError(f"model_file has no joint {short(name)}, which task {task_name} has")
        if theirs[name][0] != kind:
            raise MemobenchError(f"model_file's joint {short(name)} is of type {theirs[name][0]!r}, expected {kind!r}")
    beyond = next((name for name in theirs if name not in ours), None)
    if beyond is not None:
        body = scene.body(scene.joint(beyond).bodyid[0]).name
        raise MemobenchError(
            f"model_file moves the body {short(body)} by the joint {short(beyond)}, which task {task_name} does not "
            "have"
        )
    width = 1 + scene.nq + scene.nv
    if states.shape[1] != width:
        raise MemobenchError(f"states have width {states.shape[1]}, expected {width} of the joints of model_file")
    expected = np.array(sim.model.body(BASE).pos)
    base = np.array(scene.body(_body_of(scene, BASE)).pos)
    if not np.abs(expected - base).max() <= BASE_TOLERANCE:  # also if it is not a number
        raise MemobenchError(
            f"model_file has the arm's base {BASE!r} at {base.round(3).tolist()}, expected "
            f"{expected.round(3).tolist()}: it is of another scene than the benchmark's"
        )
    translated = np.zeros((len(states), sim.state_dim))
    translated[:, 0] = states[:, 0]
    for name, (_, columns) in ours.items():
        translated[:, columns] = states[:, theirs[name][1]]
    poses = {}
    for name in sim.fixture_poses():
        body = scene.body(_body_of(scene, name))
        if not abs(body.pos[2] - TABLE_TOP) <= NEAR_TABLE:
            raise MemobenchError(
                f"model_file has {short(name)} at {body.pos.round(3).tolist()}, not on the table at {TABLE_TOP} m: it "
                "is the scene before its fixtures were set up; store the scene of the simulation"
            )
        poses[name] = np.concatenate([body.pos, body.quat])
    return translated, poses


# --- the task ---


def task_of(file: PublishedFile, demo: PublishedDemo) -> Task:
    """Return the task that a demonstration shows, from the file's own BDDL and metadata, or raise."""
    path = PurePosixPath(file.bddl_name.replace("\\", "/"))
    name = file.path.name.removesuffix(SUFFIX).removesuffix(file.path.suffix)
    if path.name == BDDL_FILE and path.parent.name not in ("", "..", "."):
        name = path.parent.name
    elif path.stem not in ("", "..", "task_config"):
        name = path.stem
    name = file_name(name, "the task's name")
    known = get_task(name) if name in task_names(suite=None) else None
    metadata = dict(demo.metadata)
    # The frames differ between demonstrations, the task must not: its scene is compiled once.
    goals = metadata.get("subtask_goals")
    metadata["key_frame"] = [-1] * len(goals) if isinstance(goals, list) else []
    metadata["timestep_exec_start_idx"] = -1
    folders = reversed([*path.parts, *file.path.resolve().parts])
    stated = known.memory_type if known else next((folder for folder in folders if folder in MEMORY_TYPES), UNKNOWN)
    memory_type = file_name(file.attribute("memory_type") or stated, "memory_type")
    bddl_text = file.bddl_text
    if file.lacks_its_text:  # the file stores the name of an open file instead
        if known is None:
            raise MemobenchError(
                f"bddl_file_content holds {bddl_text[:60]!r}, the name of a Python object instead of the task's text, "
                f"and the catalogue has no task {name!r}; write the text into it"
            )
        bddl_text = known.bddl_text
    task = _load(name, memory_type, bddl_text, json.dumps(metadata, sort_keys=True))
    if known is None:
        return task
    if (task.bddl_text, task.metadata) == (known.bddl_text, known.metadata):
        return known
    return task if "family" in metadata else replace(task, family=known.family)


def unlike_the_catalogue(task: Task) -> str | None:
    """Return the differences of a task to the catalogue's task of its name; None if there are none or no such task."""
    if task.name not in task_names(suite=None):
        return None
    known = get_task(task.name)
    same = {
        "memory type": task.memory_type == known.memory_type,
        "instruction": task.language == known.language,
        "objects": (task.objects, task.fixtures) == (known.objects, known.fixtures),
        "placement": (task.regions, set(task.init)) == (known.regions, set(known.init)),
        "goal": task.goal == known.goal,
        "checkpoints": task.checkpoints == known.checkpoints,
    }
    differs = [part for part, is_same in same.items() if not is_same]
    if not differs:
        return None
    return (
        f"not as the catalogue's {task.name}: {', '.join(differs)}; the dataset holds the file's, but `lerobot eval` "
        "and `memobench validate` know the catalogue's by that name"
    )


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
            message = str(error).replace(str(folder / METADATA_FILE), "meta_data")
            raise MemobenchError(message.replace(str(folder / BDDL_FILE), "bddl_file_content")) from None
