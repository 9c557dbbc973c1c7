"""Files in the published HDF5 layout of demonstrations of any task."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lerobot_memobench.constants import CONTROL_HZ
from lerobot_memobench.datasets.demonstration import Demonstration, key_frames
from lerobot_memobench.datasets.hdf5 import IMAGE_NAMES
from lerobot_memobench.tasks.task import BDDL_FILE, METADATA_FILE, Task
from tests.support.libero_layout import libero_scene


def write_published(path: Path, demos: Sequence[Demonstration], scene: str | None = None) -> Path:
    """Write demonstrations of one task with key frames and images; ``scene``: their MJCF in place of the real one."""
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
            model_file = libero_scene(demo) if scene is None else scene
            group.attrs.update(num_samples=len(demo), model_file=model_file, meta_data=json.dumps(demo_metadata(demo)))
    return path


def write_foreign(path: Path, demo: Demonstration, **metadata: Any) -> Path:
    """Write a demonstration without this package's fields in ``meta_data``, and with ``metadata`` there."""
    write_published(path, [demo])
    given = json.loads((demo.task.folder / METADATA_FILE).read_text())
    given = {key: value for key, value in given.items() if key not in ("memory_type", "family", "variants", "prompt")}
    with h5py.File(path, "a") as file:
        del file["data"].attrs["memory_type"], file["data/demo_0/actions"]
        file["data/demo_0"].attrs["meta_data"] = json.dumps(given | metadata)
        file["data/demo_0/actions"] = demo.actions.astype(np.float64)
    return path


def demo_metadata(demo: Demonstration) -> dict[str, Any]:
    """Return ``meta_data``: the task's metadata with its frames filled in."""
    metadata = dict(demo.task.metadata)
    metadata["key_frame"] = key_frames(demo).tolist()
    as_list = isinstance(metadata.get("timestep_exec_start_idx"), list)
    metadata["timestep_exec_start_idx"] = [demo.exec_start] if as_list else demo.exec_start
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
        "memory_type": task.memory_type,
    }
