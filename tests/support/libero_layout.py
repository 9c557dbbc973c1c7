"""Demonstrations of LIBERO's world as HDF5: as the authors' collecting script writes them, and as published.

Bodies have robosuite's names. Written from the layouts' descriptions, independent of the reader.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lerobot_memobench.datasets.demonstration import Demonstration, key_frames
from lerobot_memobench.datasets.hdf5 import IMAGE_NAMES
from lerobot_memobench.sim.scene import get_scene
from lerobot_memobench.tasks.task import BDDL_FILE

CAMERAS = {"agentview_image": "image", "robot0_eye_in_hand_image": "wrist_image"}
LIBERO_CAMERAS = {"agentview_rgb": "image", "eye_in_hand_rgb": "wrist_image"}
FILE_OBJECT = "<_io.TextIOWrapper name='/home/them/task_config.bddl' mode='r' encoding='utf-8'>"
TYPES = ("free", "ball", "slide", "hinge")


def libero_scene(demo: Demonstration, backwards: bool = False) -> str:
    """Return the bodies and joints of the scene as MJCF; ``backwards``: the things in another order."""
    model = get_scene(demo.task).model
    root = ElementTree.Element("mujoco", model="base")
    ElementTree.SubElement(root, "compiler", angle="radian")
    bodies = {0: ElementTree.SubElement(root, "worldbody")}
    things = {*demo.task.objects, *demo.fixture_poses}
    for k in range(1, model.nbody):
        body = model.body(k)
        pose = demo.fixture_poses.get(body.name, np.concatenate([body.pos, body.quat]))
        name = f"{body.name}_main" if body.name in things else body.name
        bodies[k] = ElementTree.SubElement(
            bodies[int(body.parentid[0])], "body", name=name, pos=_words(pose[:3]), quat=_words(pose[3:])
        )
        for number in range(int(body.jntadr[0]), int(body.jntadr[0]) + int(body.jntnum[0])):
            joint = model.joint(number)
            kind = TYPES[int(joint.type[0])]
            places = {} if kind == "free" else {"pos": _words(joint.pos), "axis": _words(joint.axis)}
            ElementTree.SubElement(bodies[k], "joint", name=joint.name, type=kind, **places)
        ElementTree.SubElement(bodies[k], "geom", type="mesh", mesh="of_another_file")
    if backwards:
        bodies[0][:] = reversed(bodies[0])
    return ElementTree.tostring(root, encoding="unicode")


def _words(values: np.ndarray) -> str:
    return " ".join(repr(float(value)) for value in values)


def libero_states(demo: Demonstration, scene: str) -> np.ndarray:
    """Return the states in the order of the scene."""
    theirs, ours = _joints(scene), _joints(libero_scene(demo))
    start, parts = 1, []
    for which in range(2):
        columns = {}
        for joint, widths in ours.items():
            columns[joint], start = demo.states[:, start : start + widths[which]], start + widths[which]
        parts += [columns[joint] for joint in theirs]
    assert start == demo.states.shape[1]
    return np.concatenate([demo.states[:, :1], *parts], axis=1)


def _joints(scene: str) -> dict[str, tuple[int, int]]:
    """Return each joint's numbers of positions and velocities, in the order in which MuJoCo has them."""
    joints = ElementTree.fromstring(scene).iter("joint")
    return {joint.get("name"): (7, 6) if joint.get("type") == "free" else (1, 1) for joint in joints}


def write(
    path: Path, demo: Demonstration, *, numbers: tuple[int, ...] = (1,), text: str | None = None,
    cameras: dict[str, str] = CAMERAS, backwards: bool = False, **metadata: Any,
) -> Path:  # fmt: skip
    """Write a file of the demonstration, as many times as there are ``numbers``."""
    scene = libero_scene(demo, backwards)
    states = libero_states(demo, scene)
    given = json.loads((demo.task.folder / "task_config.meta.json").read_text())
    given = {key: given[key] for key in ("memory", "operating_type", "subtask_goals")}
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update(date="11-28-2026", time="2:10:1", repository_version="1.4.0")
        data.attrs.update(env="Libero_Kitchen_Tabletop_Manipulation", env_info=json.dumps({"robots": ["Panda"]}))
        data.attrs["problem_info"] = json.dumps({"language_instruction": demo.task.language})
        data.attrs["bddl_file_name"] = f"src/bddl/{demo.task.memory_type}/{demo.task.name}/task_config.bddl"
        data.attrs["bddl_file_content"] = demo.task.bddl_text if text is None else text
        for number in numbers:
            group = data.create_group(f"demo_{number}")
            group["states"], group["actions"] = states, demo.actions.astype(np.float64)
            for name, camera in cameras.items():
                group[f"obs/{name}"] = demo.images[camera]
            meta_data = given | {"key_frame": [-1] * len(given["subtask_goals"])} | metadata
            group.attrs.update(num_samples=len(states), model_file=scene, meta_data=json.dumps(meta_data))
    return path


def write_published(path: Path, demos: Sequence[Demonstration], scene: str | None = None) -> Path:
    """Write demonstrations of one task with key frames and images; ``scene``: their MJCF in place of the real one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        task = demos[0].task.variant(0)
        data.attrs.update(bddl_file_name=f"{task.memory_type}/{task.name}/{BDDL_FILE}", memory_type=task.memory_type)
        data.attrs.update(bddl_file_content=task.bddl_text, num_demos=len(demos), total=sum(map(len, demos)))
        for number, demo in enumerate(demos):
            assert demo.images is not None
            group = data.create_group(f"demo_{number}")
            group["states"], group["actions"] = demo.states, demo.actions
            for camera, name in IMAGE_NAMES.items():
                group.create_dataset(
                    f"obs/{name}",
                    data=demo.images[camera],
                    chunks=(1, *demo.images[camera].shape[1:]),
                    compression="gzip",
                    compression_opts=1,
                )
            model_file = libero_scene(demo) if scene is None else scene
            group.attrs.update(num_samples=len(demo), model_file=model_file, meta_data=json.dumps(demo_metadata(demo)))
    return path


def demo_metadata(demo: Demonstration) -> dict[str, Any]:
    metadata = dict(demo.task.metadata)
    metadata["key_frame"] = key_frames(demo).tolist()
    as_list = isinstance(metadata.get("timestep_exec_start_idx"), list)
    metadata["timestep_exec_start_idx"] = [demo.exec_start] if as_list else demo.exec_start
    return metadata
