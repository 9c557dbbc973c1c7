"""Files in the published HDF5 layout, with the attributes that earlier versions of this package added."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lerobot_memobench.datasets.demonstration import Demonstration, digest, labels
from lerobot_memobench.datasets.hdf5 import IMAGE_NAMES
from lerobot_memobench.protocol import CONTROL_HZ
from lerobot_memobench.tasks.formula import to_lists
from lerobot_memobench.tasks.task import BDDL_FILE, METADATA_FILE, Task

Pose = np.ndarray


def write_published(path: Path, demos: Sequence[Demonstration], scene: str | None = None) -> Path:
    """Write demonstrations of one task, images included; ``scene``: their MJCF in place of the real one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "w") as file:
        data = file.create_group("data")
        data.attrs.update(data_attributes(demos[0].task))
        data.attrs.update(num_demos=len(demos), total=sum(map(len, demos)))
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
            group.attrs.update(demo_attributes(demo))
            group.attrs["model_file"] = model_file(demo.task, demo.fixture_poses) if scene is None else scene
    return path


def write_foreign(path: Path, demo: Demonstration, **metadata: Any) -> Path:
    """Write a demonstration with the attributes of the layout only, and ``metadata`` in its ``meta_data``."""
    write_published(path, [demo])
    given = json.loads((demo.task.folder / METADATA_FILE).read_text())
    given = {key: value for key, value in given.items() if key not in ("memory_type", "family", "variants", "prompt")}
    with h5py.File(path, "a") as file:
        for group, kept in (
            (file["data"], ("bddl_file_name", "bddl_file_content", "env_info", "problem_info")),
            (file["data/demo_0"], ("num_samples", "model_file", "meta_data")),
        ):
            for key in set(group.attrs) - set(kept):
                del group.attrs[key]
        file["data/demo_0"].attrs["meta_data"] = json.dumps(given | metadata)
        del file["data/demo_0/actions"]
        file["data/demo_0/actions"] = demo.actions.astype(np.float64)
    return path


def demo_attributes(demo: Demonstration) -> dict[str, Any]:
    """Return the attributes of a demonstration's group."""
    return {
        "num_samples": len(demo),
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


def truth_to_intervals(satisfied: np.ndarray) -> list[list[list[int]]]:
    """Return where each column of a (T, K) truth is true, as [start, stop) pairs."""
    edges = np.diff(satisfied.astype(np.int8), axis=0, prepend=0, append=0)
    return [np.flatnonzero(column).reshape(-1, 2).tolist() for column in edges.T]


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
            mesh.usertexcoord = []  # useless without a texture, and MuJoCo writes them incompletely
            mesh.userfacetexcoord = []
    spec.compile()
    return str(spec.to_xml())
