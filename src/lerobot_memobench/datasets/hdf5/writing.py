"""Write demonstrations in the published layout, and their scenes as MJCF for its attribute ``model_file``."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels
from lerobot_memobench.datasets.hdf5.reading import IMAGE_NAMES, Image, truth_to_intervals
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.tasks.formula import to_lists
from lerobot_memobench.tasks.task import BDDL_FILE, Task

if TYPE_CHECKING:
    import h5py

Pose = NDArray[np.float64]
"""Position and quaternion wxyz, (7,)."""


# --- a demonstration ---


class EpisodeFile:
    """A demonstration being written frame by frame: what its ``demo_k`` will hold, at the root of its own file."""

    def __init__(self, path: Path) -> None:
        import h5py

        self._file: h5py.File = h5py.File(path, "w")
        self._images: dict[str, h5py.Dataset] = {}
        self._frames = 0

    def add_images(self, images: Mapping[str, Image]) -> None:
        """Append both cameras' next frame, (H, W, 3) uint8 each."""
        if not self._images:
            obs = self._file.create_group("obs")
            for camera, name in IMAGE_NAMES.items():
                shape = images[camera].shape
                self._images[camera] = obs.create_dataset(
                    name,
                    (0, *shape),
                    np.uint8,
                    maxshape=(None, *shape),
                    chunks=(1, *shape),
                    compression="gzip",
                    compression_opts=1,
                )
        self._frames += 1
        for camera, dataset in self._images.items():
            dataset.resize(self._frames, axis=0)
            dataset[-1] = images[camera]

    def finish(self, demo: Demonstration) -> None:
        """Add arrays and attributes and close the file."""
        self._file.create_dataset("states", data=demo.states)
        self._file.create_dataset("actions", data=demo.actions)
        self._file.attrs.update(demo_attributes(demo))
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is; it is about to be deleted. After ``finish`` this does nothing."""
        self._file.close()


def demo_attributes(demo: Demonstration) -> dict[str, Any]:
    """Return the attributes of a demonstration's group."""
    return {
        "num_samples": len(demo),
        "model_file": demo.model_xml,
        "meta_data": json.dumps(demo_metadata(demo)),
        "seed": int(demo.seed),
        "referent": demo.referent,
        "variant": int(demo.variant),
        "success": bool(demo.success),
        "fixture_poses": json.dumps({name: np.asarray(pose).tolist() for name, pose in demo.fixture_poses.items()}),
        "scene_hash": demo.scene_hash,
        "satisfied_intervals": json.dumps(truth_to_intervals(demo.satisfied)),
        "digest": digest(demo),
    }


def demo_metadata(demo: Demonstration) -> dict[str, Any]:
    """Return ``meta_data``: the task's metadata, of the variant that was carried out, with its frames filled in."""
    task = demo.task
    metadata = dict(task.metadata)
    metadata["key_frame"] = labels(demo).key_frames.tolist()
    as_list = isinstance(metadata.get("timestep_exec_start_idx"), list)
    metadata["timestep_exec_start_idx"] = [demo.exec_start] if as_list else demo.exec_start
    if task.variant_index:
        metadata.pop("variants", None)  # they are variants of the published task, not of this one
        metadata |= {
            "memory": [list(checkpoint.language) for checkpoint in task.checkpoints],
            "subtask_goals": [to_lists(checkpoint.goal) for checkpoint in task.checkpoints],
            "demo_summary": task.demo_summary,
            "goal": to_lists(task.goal),
        }
        if task.prompt is not None:
            metadata["prompt"] = {"kind": task.prompt.kind, "target": task.prompt.target}
    return metadata


# --- a task's file ---


def data_attributes(task: Task) -> dict[str, Any]:
    """Return the attributes of a task's ``data`` group."""
    task = task.variant(0)
    problem = re.search(r"\(\s*problem\s+([^\s()]+)", task.bddl_text)
    domain = re.search(r"\(\s*:domain\s+([^\s()]+)", task.bddl_text)
    env_info = {
        "env_name": problem.group(1) if problem else task.name,
        "type": 1,
        "env_kwargs": {
            "robots": ["Panda"],
            "controller": "OSC_POSE",
            "control_freq": CONTROL_HZ,
            "camera_names": ["agentview", "robot0_eye_in_hand"],
        },
    }
    problem_info = {
        "problem_name": env_info["env_name"],
        "domain_name": domain.group(1) if domain else "robosuite",
        "language_instruction": task.language,
    }
    return {
        "bddl_file_name": f"{task.memory_type}/{task.name}/{BDDL_FILE}",
        "bddl_file_content": task.bddl_text,
        "env_info": json.dumps(env_info),
        "problem_info": json.dumps(problem_info),
        "task_metadata": json.dumps(task.metadata),
        "memory_type": task.memory_type,
        "family": task.family,
    }


def write_task_file(path: Path, attributes: Mapping[str, Any], episodes: Sequence[Path]) -> None:
    """Join demonstrations, each a file of an :class:`EpisodeFile`, to a task's file; chunks are copied as they are."""
    import h5py

    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as target:
        data = target.create_group("data")
        data.attrs.update(attributes)
        total = 0
        for number, episode in enumerate(episodes):
            with h5py.File(episode) as source:
                group = data.create_group(f"demo_{number}")
                for name in source:
                    source.copy(name, group)
                group.attrs.update(source.attrs)
                total += int(source.attrs["num_samples"])
        data.attrs["num_demos"], data.attrs["total"] = len(episodes), total


# --- the scene ---


def model_file(task: Task, fixture_poses: Mapping[str, Pose]) -> str:
    """Return a task's scene as MJCF, its fixtures at ``fixture_poses`` (written exactly).

    MuJoCo has no text form for textures that are not files; they are written as flat ones. So the text has every body,
    joint, site, inertia and collision shape of the scene, at its real place, and plain colours. Meshes of the arm are
    named by their files, as robosuite's own ``model_file`` names them.
    """
    root = ElementTree.fromstring(_scene_xml(task))
    bodies = {body.get("name"): body for body in root.iterfind("worldbody/body")}
    for name, pose in fixture_poses.items():
        for key, part in (("pos", pose[:3]), ("quat", pose[3:])):
            bodies[name].set(key, " ".join(repr(float(value)) for value in part))
    return ElementTree.tostring(root, encoding="unicode")


@lru_cache(maxsize=2)
def _scene_xml(task: Task) -> str:
    import mujoco

    from lerobot_memobench.sim.scene import scene_spec

    spec, _ = scene_spec(task)
    for texture in spec.textures:
        texture.data = b""
        texture.builtin = mujoco.mjtBuiltin.mjBUILTIN_FLAT
        texture.width = texture.height = 16
        texture.rgb1 = [0.8, 0.8, 0.8]
    for mesh in spec.meshes:
        if not mesh.file:
            mesh.usertexcoord = []  # without a picture they say nothing, and MuJoCo writes them incompletely
            mesh.userfacetexcoord = []
    spec.compile()
    return str(spec.to_xml())
