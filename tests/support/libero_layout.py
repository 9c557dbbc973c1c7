"""A demonstration of ours as LIBERO's collecting script would have written it: its scene, its states, its attributes.

Bodies have LIBERO's names and frames, objects stand before fixtures, drawers from the top down, and the state's numbers
are in that order. Written from the layout's description, with nothing of the reader but the table of frames.
"""

from __future__ import annotations

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.hdf5.frames import FRAMES, QUARTER, Frame

CAMERAS = {"agentview_image": "image", "robot0_eye_in_hand_image": "wrist_image"}
LIBERO_CAMERAS = {"agentview_rgb": "image", "eye_in_hand_rgb": "wrist_image"}
SCAN = Frame(QUARTER, (0.0, 0.0, 0.03))
"""Frame of the authors' scans in this layout: no table of the reader has it."""
FILE_OBJECT = "<_io.TextIOWrapper name='/home/them/task_config.bddl' mode='r' encoding='utf-8'>"


def libero_scene(demo: Demonstration) -> str:
    """Return the scene as MJCF."""
    root = ElementTree.fromstring(demo.model_xml)
    root.set("model", "base")
    world = root.find("worldbody")
    classes = {**demo.task.objects, **demo.task.fixtures}
    bodies = {body.get("name"): body for body in world.iterfind("body")}
    things = [*demo.task.objects, *demo.fixture_poses]
    for name in things:
        world.remove(bodies[name])
    for name in things:
        moves = name in demo.task.objects
        world.append(_wrapped(bodies[name], classes[name], None if moves else demo.fixture_poses[name]))
    return ElementTree.tostring(root, encoding="unicode")


def _wrapped(body: ElementTree.Element, class_name: str, pose: np.ndarray | None) -> ElementTree.Element:
    """Return a body in LIBERO's frame around a body in ours."""
    frame = FRAMES.get(class_name, SCAN)
    turn = Rotation.from_quat(frame.upright, scalar_first=True).inv()
    origin = turn.apply(frame.shift)
    name = body.get("name")
    outer = ElementTree.Element("body", name=f"{name}_main")
    if pose is not None:
        turned = Rotation.from_quat(pose[3:], scalar_first=True) * turn.inv()
        _put(outer, pose[:3] - turned.apply(origin), turned)
    for joint in [*body.iterfind("joint"), *body.iterfind("freejoint")]:
        body.remove(joint)
        outer.append(joint)
    parts = body.findall("body")
    for part in parts:
        body.remove(part)
    body.extend(reversed(parts))
    body.set("name", f"{name}_object")
    _put(body, origin, turn)
    outer.append(body)
    return outer


def _put(body: ElementTree.Element, position: np.ndarray, turned: Rotation) -> None:
    body.set("pos", " ".join(map(repr, map(float, position))))
    body.set("quat", " ".join(map(repr, map(float, turned.as_quat(scalar_first=True)))))


def libero_states(demo: Demonstration, scene: str) -> np.ndarray:
    """Return the states in the order and the frames of the scene."""
    theirs, ours = _joints(scene), _joints(demo.model_xml)
    nq = sum(width for width, _ in ours.values())
    start, positions = 1, {}
    for joint, (width, _) in ours.items():
        positions[joint], start = demo.states[:, start : start + width], start + width
    velocities = {}
    for joint, (_, width) in ours.items():
        velocities[joint], start = demo.states[:, start : start + width], start + width
    assert start == demo.states.shape[1] > nq
    for joint, (width, _) in ours.items():
        if width == 7:
            frame = FRAMES.get(demo.task.objects[joint.removesuffix("_joint0")], SCAN)
            positions[joint], velocities[joint] = _theirs(frame, positions[joint], velocities[joint])
    parts = [demo.states[:, :1], *(positions[joint] for joint in theirs), *(velocities[joint] for joint in theirs)]
    return np.concatenate(parts, axis=1)


def _theirs(frame: Any, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    upright = Rotation.from_quat(frame.upright, scalar_first=True)
    turned = Rotation.from_quat(position[:, 3:], scalar_first=True) * upright
    away = turned.apply(upright.inv().apply(frame.shift))
    spin = Rotation.from_quat(position[:, 3:], scalar_first=True).apply(velocity[:, 3:])
    linear = velocity[:, :3] - np.cross(spin, away)
    return (
        np.concatenate([position[:, :3] - away, turned.as_quat(scalar_first=True)], axis=1),
        np.concatenate([linear, turned.inv().apply(spin)], axis=1),
    )


def _joints(scene: str) -> dict[str, tuple[int, int]]:
    """Return each joint's numbers of positions and velocities, in the order in which MuJoCo has them."""
    found = {}
    for element in ElementTree.fromstring(scene).iter():
        if element.tag in ("joint", "freejoint") and element.get("name") and "joint" not in element.attrib:
            free = element.tag == "freejoint" or element.get("type") == "free"
            found[element.get("name")] = (7, 6) if free else (1, 1)
    return found


def write(
    path: Path, demo: Demonstration, *, numbers: tuple[int, ...] = (1,), text: str | None = None,
    cameras: dict[str, str] = CAMERAS, **metadata: Any,
) -> Path:  # fmt: skip
    """Write a file of the demonstration, as many times as there are ``numbers``."""
    scene = libero_scene(demo)
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
